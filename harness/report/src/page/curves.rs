//! Reads signals, flagged windows and setpoint steps from the rows of a trace, and samples all trials at the same
//! instants, which the plotting library draws fast.

use crate::time_chart::TimeWindow;
use platebench_document::chart::marks::Point;
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

/// Ascending instants at which all trials are sampled.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct TimeGrid {
    pub(crate) t_ms: Vec<f64>,
}

impl TimeGrid {
    /// Selects about `limit` instants, half in `response`, or all of `rows` if they are fewer.
    pub(crate) fn new(rows: &[Row], whole: TimeWindow, response: Option<TimeWindow>, limit: usize) -> Self {
        let mut t_ms = Vec::new();
        match response {
            None => t_ms.extend(window_instants(rows, whole, limit)),
            Some(response) => {
                let rest = (whole.span_ms() - response.span_ms()).max(f64::MIN_POSITIVE);
                for (from_ms, to_ms) in [
                    (whole.from_ms, response.from_ms),
                    (response.from_ms, response.to_ms),
                    (response.to_ms, whole.to_ms),
                ] {
                    let window = TimeWindow { from_ms, to_ms };
                    let is_response = window == response;
                    let share = if is_response { 0.5 } else { 0.5 * window.span_ms() / rest };
                    if window.span_ms() > 0.0 {
                        t_ms.extend(window_instants(rows, window, (limit as f64 * share) as usize));
                    }
                }
            }
        }
        t_ms.dedup();
        Self { t_ms }
    }

    pub(crate) fn align<'a>(&'a self, rows: &'a [Row]) -> AlignedRows<'a> {
        AlignedRows { t_ms: &self.t_ms, rows, rows_until: rows_until(rows, &self.t_ms) }
    }
}

/// Rows of a trial at the instants of a grid. The search for each instant serves all signals.
pub(crate) struct AlignedRows<'a> {
    t_ms: &'a [f64],
    rows: &'a [Row],
    rows_until: Vec<usize>,
}

impl AlignedRows<'_> {
    pub(crate) fn sample(&self, signal: Column) -> Vec<Option<f64>> {
        let instants = self.t_ms.iter().zip(&self.rows_until);
        instants.map(|(t_ms, next)| value_at(self.rows, *next, signal, *t_ms)).collect()
    }

    /// Keeps every peak. If the signal leaves the range of its values at three neighbouring
    /// instants, its lowest and highest value replace the first two values, in order of time.
    pub(crate) fn sample_peaks(&self, signal: Column) -> Vec<Option<f64>> {
        let mut line = self.sample(signal);
        for start in (0..line.len()).step_by(2) {
            let end = (start + 2).min(line.len() - 1);
            let (Some(instants), Some(values)) = (self.t_ms.get(start..=end), line.get(start..=end)) else { continue };
            let until = |index: usize| self.rows_until.get(index).copied().unwrap_or_default();
            let between = self.rows.get(until(start)..until(end)).unwrap_or_default();
            let hidden = || points(between, signal).filter(|(t_ms, _)| !instants.contains(t_ms));
            let range = |(low, high): (f64, f64), value: &f64| (low.min(*value), high.max(*value));
            let (low, high) = values.iter().flatten().fold((f64::INFINITY, f64::NEG_INFINITY), range);
            // Most points pass the first comparison, which is cheaper than the search.
            if points(between, signal).all(|(t_ms, value)| low <= value && value <= high || instants.contains(&t_ms)) {
                continue;
            }
            let known = instants.iter().zip(values).take(2).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
            let all: Vec<Point> = known.chain(hidden()).collect();
            let by_value = |a: &&Point, b: &&Point| a.1.total_cmp(&b.1);
            let mut ends = [all.iter().min_by(by_value).copied(), all.iter().max_by(by_value).copied()];
            ends.sort_by(|a, b| a.map_or(0.0, |a| a.0).total_cmp(&b.map_or(0.0, |b| b.0)));
            for (value, end) in line.iter_mut().skip(start).zip(ends) {
                *value = end.map(|(_, value)| value);
            }
        }
        line
    }
}

/// The instants of the rows in `window` with both ends, or `limit` equidistant instants.
fn window_instants(rows: &[Row], window: TimeWindow, limit: usize) -> Vec<f64> {
    let limit = limit.max(4);
    let inside = points_between(rows, Column::Setpoint, window.from_ms, window.to_ms).map(|(t_ms, _)| t_ms);
    let mut own: Vec<f64> = std::iter::once(window.from_ms).chain(inside).chain([window.to_ms]).collect();
    own.dedup();
    if own.len() <= limit {
        return own;
    }
    let last = (limit - 1) as f64;
    (0..limit).map(|index| window.from_ms + window.span_ms() * index as f64 / last).collect()
}

/// Values are interpolated between trials. `None` at instants with fewer than two trials.
pub(crate) fn percentiles(trials: &[&[Option<f64>]], shares: [f64; 3]) -> [Vec<Option<f64>>; 3] {
    let length = trials.iter().map(|trial| trial.len()).max().unwrap_or(0);
    let mut found: [Vec<Option<f64>>; 3] = std::array::from_fn(|_| Vec::with_capacity(length));
    for index in 0..length {
        let mut values: Vec<f64> = trials.iter().filter_map(|trial| *trial.get(index)?).collect();
        values.sort_by(f64::total_cmp);
        for (line, share) in found.iter_mut().zip(shares) {
            let place = share * (values.len().saturating_sub(1)) as f64;
            let ends = (values.get(place.floor() as usize), values.get(place.ceil() as usize));
            line.push(match ends {
                (Some(low), Some(high)) if values.len() > 1 => Some(low + (high - low) * place.fract()),
                _ => None,
            });
        }
    }
    found
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

    fn counted_rows(count: u32, value: impl Fn(u32) -> f64) -> Vec<Row> {
        let row = |n: u32| Row { t_s: f64::from(n) * 1e-4, amplitude_um: value(n), ..Row::default() };
        (0..=count).map(row).collect()
    }

    const WHOLE: TimeWindow = TimeWindow { from_ms: 0.0, to_ms: 100.0 };

    #[test]
    fn every_row_keeps_its_instant_if_they_fit() {
        let rows = counted_rows(10, f64::from);
        let window = TimeWindow { from_ms: 0.0, to_ms: 1.0 };
        let grid = TimeGrid::new(&rows, window, None, 11);
        assert_eq!(grid.t_ms.len(), 11);
        let values: Vec<f64> =
            grid.align(&rows).sample_peaks(Column::Amplitude).into_iter().map(Option::unwrap).collect();
        assert_eq!(values, (0..=10).map(f64::from).collect::<Vec<_>>());
        assert_eq!(TimeGrid::new(&rows, window, None, 10).t_ms.len(), 10);
    }

    #[test]
    fn keeps_a_single_peak() {
        let rows = counted_rows(1_000, |n| if n == 617 { 9.0 } else { 1.0 });
        let grid = TimeGrid::new(&rows, WHOLE, None, 50);
        let line = grid.align(&rows).sample_peaks(Column::Amplitude);
        assert_eq!(line.len(), grid.t_ms.len());
        assert_eq!(line.iter().flatten().filter(|value| **value == 9.0).count(), 1);
        assert!(
            grid.align(&rows).sample(Column::Amplitude).iter().flatten().all(|value| *value < 9.0),
            "not at an instant"
        );
    }

    #[test]
    fn the_response_gets_half_of_the_instants() {
        let rows = counted_rows(1_000, f64::from);
        let response = TimeWindow { from_ms: 10.0, to_ms: 20.0 };
        let grid = TimeGrid::new(&rows, WHOLE, Some(response), 100);
        let inside = grid.t_ms.iter().filter(|t_ms| (10.0..=20.0).contains(*t_ms)).count();
        assert!((48..=52).contains(&inside) && grid.t_ms.len() <= 100, "{inside} of {}", grid.t_ms.len());
        assert!(grid.t_ms.is_sorted_by(|a, b| a < b));
        assert_eq!((grid.t_ms[0], *grid.t_ms.last().unwrap()), (0.0, 100.0));
    }

    #[test]
    fn a_short_trial_leaves_a_gap() {
        let (long, short) = (counted_rows(1_000, f64::from), counted_rows(500, f64::from));
        let grid = TimeGrid::new(&long, WHOLE, None, 21);
        assert!(grid.align(&long).sample_peaks(Column::Amplitude).iter().all(Option::is_some));
        let line = grid.align(&short).sample_peaks(Column::Amplitude);
        assert!(line[8].is_some() && line[12].is_none() && line[20].is_none(), "{line:?}");
    }

    #[test]
    fn percentiles_interpolate_and_need_two_trials() {
        let trials: Vec<Vec<Option<f64>>> = (0..=20).map(|n| vec![Some(f64::from(n)), None]).collect();
        let trials: Vec<&[Option<f64>]> = trials.iter().map(Vec::as_slice).collect();
        let [low, middle, high] = percentiles(&trials, [0.05, 0.5, 0.95]);
        assert_eq!((low[0], middle[0], high[0]), (Some(1.0), Some(10.0), Some(19.0)));
        assert_eq!(low[1], None);
        let [half, ..] = percentiles(&trials[..2], [0.5, 0.0, 1.0]);
        assert_eq!(half[0], Some(0.5));
        assert_eq!(percentiles(&trials[..1], [0.0, 0.5, 1.0])[0], [None, None]);
    }
}
