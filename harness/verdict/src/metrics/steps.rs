//! Finds the setpoint steps of a trace.

use super::window::end_index;
use platebench_model::scenario::Window;
use platebench_model::trace::{Flags, Row};

/// Indices of the rows at which steps start. A constant setpoint above 0 steps at the start. A ramp
/// or curve is one step from the row before its first change. It ends when two instants in a row do
/// not change, because a curve may rest for one instant at its crest.
pub fn setpoint_steps(rows: &[Row]) -> Vec<usize> {
    let mut steps = Vec::new();
    let mut before = 0.0;
    let mut start = 0;
    let (mut moved, mut rested) = (0_u32, 0_u32);
    for instant in rows.chunk_by(|a, b| a.t_s == b.t_s) {
        let first_moved = instant.iter().position(|row| row.setpoint_um != before);
        before = instant.last().map_or(before, |row| row.setpoint_um);
        match first_moved {
            Some(offset) => {
                let continues = moved > 0 && (rested == 0 || (moved > 1 && rested == 1));
                if continues {
                    moved += 1;
                } else {
                    steps.push(start + offset);
                    // The initial setpoint is no change that a ramp could continue.
                    moved = u32::from(start > 0);
                }
                if moved == 2 && continues {
                    // Two changes in a row are a ramp, which starts at the row before the first
                    // change.
                    let began = steps.pop().map_or(0, |step| step.saturating_sub(1));
                    if steps.last() != Some(&began) {
                        steps.push(began);
                    }
                }
                rested = 0;
            }
            None => rested += 1,
        }
        start += instant.len();
    }
    steps
}

/// The telemetry of a real plate shows a setpoint up to this much later than the profile.
const MAX_TELEMETRY_DELAY_S: f64 = 0.1;

/// Rows from the step to the next step or the end of the window, and the setpoint before the step.
pub(super) fn step_response<'a>(window: &Window, rows: &'a [Row]) -> Option<(&'a [Row], f64)> {
    let delay = if rows.iter().any(|row| row.flags.contains(Flags::SENSED)) { MAX_TELEMETRY_DELAY_S } else { 0.0 };
    let from = window.from.seconds();
    let steps = setpoint_steps(rows);
    let is_after = |step: &&usize| rows.get(**step).is_some_and(|row| row.t_s >= from);
    let position = steps.iter().position(|step| is_after(&step)).unwrap_or(steps.len().saturating_sub(1));
    let start = *steps.get(position)?;
    let window_end = end_index(window.to.seconds() + delay, rows);
    let end = steps.get(position + 1).copied().unwrap_or(rows.len()).min(window_end);
    let before = start.checked_sub(1).and_then(|index| rows.get(index)).map_or(0.0, |row| row.setpoint_um);
    rows.get(start..end).map(|part| (part, before))
}
