//! Reads signals, flagged windows and setpoint steps from the rows of a trace.

use crate::chart::marks::Point;
use crate::chart::time::TimeWindow;
use platebench_model::trace::{Column, Flags, Row};
use platebench_verdict::metrics::setpoint_steps;

/// Columns that the page draws.
pub(crate) const PLOTTED_COLUMNS: [Column; 9] = [
    Column::Amplitude,
    Column::Wd,
    Column::Wq,
    Column::Setpoint,
    Column::Drive,
    Column::Frequency,
    Column::Resonance,
    Column::Force,
    Column::Temperature,
];

/// Empty for a column that the page does not draw.
pub(crate) const fn unit(column: Column) -> &'static str {
    match column {
        Column::Amplitude | Column::Wd | Column::Wq | Column::Setpoint => "µm",
        Column::Drive => "Vpp",
        Column::Frequency | Column::Resonance => "Hz",
        Column::Force => "N",
        Column::Temperature => "K",
        Column::Time | Column::SensedWd | Column::SensedWq | Column::Lateness => "",
    }
}

/// True for values that stay constant until the next row. Other signals are interpolated.
pub(crate) const fn is_zero_order_hold(column: Column) -> bool {
    matches!(column, Column::Setpoint | Column::Drive | Column::Frequency)
}

fn row_ms(row: &Row) -> f64 {
    row.t_s * 1e3
}

/// Points after `from_ms`, up to and including `to_ms`.
pub(crate) fn points_between(rows: &[Row], signal: Column, from_ms: f64, to_ms: f64) -> impl Iterator<Item = Point> {
    let start = rows.partition_point(|row| row_ms(row) <= from_ms);
    let end = rows.partition_point(|row| row_ms(row) <= to_ms);
    points(rows.get(start..end).unwrap_or_default(), signal)
}

pub(crate) fn points(rows: &[Row], signal: Column) -> impl Iterator<Item = Point> {
    rows.iter().map(move |row| (row_ms(row), signal.value(row)))
}

/// `next` is the number of rows up to `at_ms`. `None` outside the trace.
pub(crate) fn value_at(rows: &[Row], next: usize, signal: Column, at_ms: f64) -> Option<f64> {
    let point = |row: &Row| (row_ms(row), signal.value(row));
    interpolate_between(point(rows.get(next.checked_sub(1)?)?), rows.get(next).map(point), signal, at_ms)
}

/// Number of rows up to each of the ascending instants.
pub(crate) fn rows_until(rows: &[Row], t_ms: &[f64]) -> Vec<usize> {
    let mut count = 0;
    let until = |t_ms: &f64| {
        let after = rows.get(count..).unwrap_or_default();
        count += after.iter().take_while(|row| row_ms(row) <= *t_ms).count();
        count
    };
    t_ms.iter().map(until).collect()
}

pub(crate) fn interpolate(points: &[Point], signal: Column, at_ms: f64) -> Option<f64> {
    let next = points.partition_point(|point| point.0 <= at_ms);
    interpolate_between(*points.get(next.checked_sub(1)?)?, points.get(next).copied(), signal, at_ms)
}

fn interpolate_between(before: Point, after: Option<Point>, signal: Column, at_ms: f64) -> Option<f64> {
    let Some(after) = after else { return (before.0 == at_ms).then_some(before.1) };
    if is_zero_order_hold(signal) {
        return Some(before.1);
    }
    let share = (at_ms - before.0) / (after.0 - before.0);
    Some(before.1 + (after.1 - before.1) * share)
}

pub(crate) fn flagged_windows(rows: &[Row], flags: Flags) -> Vec<TimeWindow> {
    let mut windows: Vec<TimeWindow> = Vec::new();
    for [row, next] in rows.array_windows() {
        let (from_ms, to_ms) = (row_ms(row), row_ms(next));
        if row.flags.intersects(flags) && from_ms < to_ms {
            windows.push(TimeWindow { from_ms, to_ms });
        }
    }
    merge_windows(windows)
}

pub(crate) fn overrun_instants(rows: &[Row]) -> impl Iterator<Item = f64> {
    rows.iter().filter(|row| row.flags.contains(Flags::OVERRUN)).map(row_ms)
}

pub(crate) fn merge_windows(mut windows: Vec<TimeWindow>) -> Vec<TimeWindow> {
    windows.sort_by(|a, b| a.from_ms.total_cmp(&b.from_ms));
    let mut result: Vec<TimeWindow> = Vec::new();
    for window in windows {
        match result.last_mut() {
            Some(last) if window.from_ms <= last.to_ms => last.to_ms = last.to_ms.max(window.to_ms),
            _ => result.push(window),
        }
    }
    result
}

pub(crate) fn setpoint_steps_ms(rows: &[Row]) -> Vec<f64> {
    setpoint_steps(rows).into_iter().filter_map(|step| rows.get(step).map(row_ms)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(values: &[(f64, f64)]) -> Vec<Row> {
        let row = |&(t_ms, value): &(f64, f64)| Row {
            t_s: t_ms / 1e3,
            amplitude_um: value,
            drive_vpp: value,
            setpoint_um: value,
            ..Row::default()
        };
        values.iter().map(row).collect()
    }

    #[test]
    fn interpolates_the_plate_and_holds_the_drive() {
        let rows = rows(&[(0.0, 0.0), (2.0, 4.0), (4.0, 4.0)]);
        let at = |signal, at_ms| value_at(&rows, rows_until(&rows, &[0.5, at_ms])[1], signal, at_ms);
        assert_eq!(at(Column::Amplitude, 1.0), Some(2.0));
        assert_eq!(at(Column::Drive, 1.0), Some(0.0));
        assert_eq!(at(Column::Amplitude, 4.0), Some(4.0));
        assert_eq!(at(Column::Drive, 4.5), None);
    }

    #[test]
    fn interpolates_lines_like_their_signal() {
        let points = [(0.0, 0.0), (2.0, 4.0)];
        let at = |signal, at_ms| interpolate(&points, signal, at_ms);
        assert_eq!((at(Column::Amplitude, 1.0), at(Column::Drive, 1.0)), (Some(2.0), Some(0.0)));
        assert_eq!((at(Column::Drive, 2.0), at(Column::Drive, 2.1), at(Column::Drive, -0.1)), (Some(4.0), None, None));
    }

    #[test]
    fn a_ramp_is_one_step() {
        let steps = setpoint_steps_ms(&rows(&[
            (0.0, 0.0),
            (1.0, 0.0),
            (1.0, 2.0),
            (2.0, 2.0),
            (3.0, 2.5),
            (3.5, 3.0),
            (4.0, 3.0),
        ]));
        // A ramp begins at the row before the first change.
        assert_eq!(steps, [1.0, 2.0]);
        assert_eq!(setpoint_steps_ms(&rows(&[(0.0, 2.0), (1.0, 2.0)])), [0.0]);
    }

    #[test]
    fn saturation_lasts_until_the_next_row() {
        let mut rows = rows(&[(0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (3.0, 1.0)]);
        rows[1].flags = Flags::SATURATED | Flags::CONTROL;
        rows[2].flags = Flags::SATURATED;
        assert_eq!(flagged_windows(&rows, Flags::SATURATED), [TimeWindow { from_ms: 1.0, to_ms: 3.0 }]);
    }
}
