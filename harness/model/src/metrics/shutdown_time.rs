//! Measures how fast a controller stops at 0 V.

use super::input::{MeasureInput, rounded_ms};
use super::measurement::{Measure, MissingValue};
use super::spec::{ElapsedLabels, MetricSpec, Subject, Unit, ValidIf, WindowRule};
use crate::trace::{Flags, Row};

pub(super) const SHUTDOWN_TIME: MetricSpec = MetricSpec {
    name: "shutdown_time_ms",
    unit: Unit::Milliseconds,
    definition: "from `from_ms` (required) to the instant from which the controller has stopped and the drive is 0 V, \
                 until the end of the trial or of the next fault that reconfigures",
    window: WindowRule::FromDisturbance,
    subject: Subject::Controller,
    valid_if: ValidIf::Present,
    elapsed: Some(ElapsedLabels { reached: "stopped after", not_reached: "does not stop", is_on_drive: true }),
    measure: |input| Ok(shutdown_time(input).into()),
    ..MetricSpec::DEFAULT
};

/// Time to the first row from which the controller is stopped at 0 V until the window ends.
fn shutdown_time(input: &MeasureInput<'_>) -> Measure {
    let from = input.from_s;
    let has_stopped = |row: &Row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0;
    let rows = input.rows_until_end();
    let Some(ran) = rows.iter().rposition(|row| !has_stopped(row)) else {
        return Measure::Missing(MissingValue::NeverRan);
    };
    let before = rows.get(..=ran).unwrap_or_default();
    if before.iter().any(|row| row.setpoint_um > 0.0) && before.iter().all(|row| row.drive_vpp == 0.0) {
        return Measure::Missing(MissingValue::NeverDrove);
    }
    match rows.get(ran + 1) {
        None => Measure::Missing(MissingValue::NotAtRest),
        Some(stopped) if stopped.t_s < from => Measure::Missing(MissingValue::StoppedBefore),
        // On a real plate, the stop is known only to lie between two rows of telemetry.
        Some(stopped) if stopped.flags.contains(Flags::SENSED) => {
            let last = rows.get(ran).map_or(from, |row| row.t_s).max(from);
            Measure::Interval([last, stopped.t_s].map(|t_s| rounded_ms((t_s - from) * 1e3)))
        }
        Some(stopped) => Measure::Value((stopped.t_s - from) * 1e3),
    }
}
