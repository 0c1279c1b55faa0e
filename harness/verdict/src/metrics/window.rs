//! Averages over a window.

use super::signal::MetricSignal;
use platebench_record::UndefinedValue;
use platebench_scenario::Window;
use platebench_trace::{Flags, Row};

/// Time-weighted mean divided by the setpoint, which must be constant: a mean over a moving one
/// could be right for a signal that is stuck.
pub(super) fn window_mean_ratio(signal: MetricSignal, window: &Window, rows: &[Row]) -> Result<f64, UndefinedValue> {
    let (from, to) = (window.from.seconds(), window.to.seconds());
    let mut setpoint = None;
    let (mut area, mut length) = (0.0, 0.0);
    for pair in rows.windows(2) {
        let [left, right] = pair else { continue };
        let (start, end) = (left.t_s.max(from), right.t_s.min(to));
        if start >= end {
            continue;
        }
        if *setpoint.get_or_insert(left.setpoint_um) != left.setpoint_um {
            return Err(UndefinedValue::SetpointChanges);
        }
        let level = if signal.is_zero_order_hold {
            signal.value_in(left)
        } else {
            // Linear between rows: the mean over a piece is the value at its middle.
            let share = (f64::midpoint(start, end) - left.t_s) / (right.t_s - left.t_s);
            signal.value_in(left) + (signal.value_in(right) - signal.value_in(left)) * share
        };
        area += (end - start) * level;
        length += end - start;
    }
    match setpoint {
        Some(setpoint) if setpoint > 0.0 => Ok(area / length / setpoint),
        Some(_) => Err(UndefinedValue::ZeroSetpoint),
        None => Err(UndefinedValue::EmptyWindow),
    }
}

pub(super) fn flagged_share(rows: &[Row], flag: Flags) -> f64 {
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else { return 0.0 };
    let flagged: f64 = rows
        .windows(2)
        .filter_map(|pair| match pair {
            [left, right] if left.flags.contains(flag) => Some(right.t_s - left.t_s),
            _ => None,
        })
        .sum();
    if last.t_s > first.t_s { flagged / (last.t_s - first.t_s) } else { 0.0 }
}
