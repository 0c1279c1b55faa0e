//! Selects the rows of a window and evaluates them.

use super::signal::MetricSignal;
use platebench_model::record::UndefinedValue;
use platebench_model::scenario::Window;
use platebench_model::trace::{Flags, Row};

/// The row at the end belongs to the next window, except at the end of the trace.
pub(super) fn window_rows<'a>(window: &Window, rows: &'a [Row]) -> &'a [Row] {
    let start = rows.partition_point(|row| row.t_s < window.from.seconds());
    rows.get(start..end_index(window.to.seconds(), rows)).unwrap_or_default()
}

/// Number of rows before `to_s`; all rows if the trace ends by then.
pub(super) fn end_index(to_s: f64, rows: &[Row]) -> usize {
    let is_last = rows.last().is_none_or(|row| to_s >= row.t_s);
    if is_last { rows.len() } else { rows.partition_point(|row| row.t_s < to_s) }
}

/// Also contains the row before the window, whose drive and flags are in force at its start.
pub(super) fn window_rows_with_previous<'a>(window: &Window, rows: &'a [Row]) -> &'a [Row] {
    let inside = window_rows(window, rows);
    let from = window.from.seconds();
    if inside.first().is_some_and(|row| row.t_s == from) {
        return inside;
    }
    let start = rows.partition_point(|row| row.t_s < from);
    rows.get(start.saturating_sub(1)..start + inside.len()).unwrap_or_default()
}

pub(super) fn ripple_um(signal: MetricSignal, rows: &[Row]) -> Option<f64> {
    let values = || rows.iter().map(|row| signal.value_in(row));
    Some(values().reduce(f64::max)? - values().reduce(f64::min)?)
}

/// Time-weighted mean divided by the setpoint. Fails if the setpoint changes, because a stuck
/// signal could match its mean.
pub(super) fn window_mean_ratio(signal: MetricSignal, window: &Window, rows: &[Row]) -> Result<f64, UndefinedValue> {
    let (from, to) = (window.from.seconds(), window.to.seconds());
    let mut setpoint = None;
    let (mut area, mut length) = (0.0, 0.0);
    for [left, right] in rows.array_windows() {
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
            // The mean over a linear piece is its value at the middle.
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
        .array_windows()
        .filter(|[left, _]| left.flags.contains(flag))
        .map(|[left, right]| right.t_s - left.t_s)
        .sum();
    if last.t_s > first.t_s { flagged / (last.t_s - first.t_s) } else { 0.0 }
}
