//! Measures how fast a controller stops at 0 V.

use super::band::rounded_ms;
use super::measure::Measure;
use super::window::end_index;
use platebench_model::record::MissingValue;
use platebench_model::scenario::Window;
use platebench_model::trace::{Flags, Row};

/// Time to the first row from which the controller is stopped at 0 V until the window ends.
pub(super) fn shutdown_time(window: &Window, rows: &[Row]) -> Measure {
    let from = window.from.seconds();
    let has_stopped = |row: &Row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0;
    let rows = rows.get(..end_index(window.to.seconds(), rows)).unwrap_or_default();
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
