//! Takes samples and commands from a table of telemetry with named columns.

use super::error::ReplayError;
use super::input::ReplayInput;
use super::recorded_trace::{check_recording, missing_sample};
use platebench_model::external_csv::{ColumnMapping, read_rows};
use platebench_model::scenario::load;
use platebench_model::trace::{AtPath as _, MAX_TABLE_BYTES, open_regular_file};
use platebench_plate::Time;
use platebench_verdict::replay::{Recording, ReplayCommand, ReplayStep};
use std::f64::consts::TAU;
use std::path::Path;

/// Setpoints come from the table, or from the scenario's profile if the table has none.
pub fn read_telemetry_table(
    table: &Path,
    columns: &ColumnMapping,
    scenario: &Path,
) -> Result<ReplayInput, ReplayError> {
    let scenario = load(scenario, &scenario.display().to_string())?;
    let name = table.display().to_string();
    let file = open_regular_file(table, MAX_TABLE_BYTES).at(table)?;
    let rows = read_rows(&name, file, columns)?;
    let first_s = rows.first().map_or(0.0, |row| row.t);
    let period_s = scenario.controller.period.seconds();
    let (mut steps, mut end, mut previous) = (Vec::with_capacity(rows.len()), None, None);
    for row in rows {
        let t_s = row.t - first_s;
        end = previous.and_then(|previous| missing_sample(previous, t_s, period_s));
        if end.is_some() {
            break;
        }
        previous = Some(t_s);
        let profile = || {
            let time = Time::from_seconds(t_s).filter(|time| *time <= scenario.duration);
            time.map(|time| scenario.setpoint.at(time))
        };
        let setpoint_um = row.setpoint_um.or_else(profile).ok_or_else(|| ReplayError::NoSetpoint {
            path: table.to_owned(),
            duration_s: scenario.duration.seconds(),
            at_s: t_s,
        })?;
        let command = Some(ReplayCommand { drive_vpp: row.vpp, frequency_hz: row.omega / TAU });
        steps.push(ReplayStep { t_s, setpoint_um, wd_um: row.w.re, wq_um: row.w.im, command });
    }
    let recording = Recording { name, steps, end };
    check_recording(table, &recording, period_s)?;
    Ok(ReplayInput { recording, scenario })
}
