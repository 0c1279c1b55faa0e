//! Samples all trials at the same instants, which the plotting library draws fast.

use super::curves;
use crate::chart::marks::Point;
use crate::chart::time::TimeWindow;
use platebench_model::trace::{Column, Row};

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
        AlignedRows { t_ms: &self.t_ms, rows, rows_until: curves::rows_until(rows, &self.t_ms) }
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
        instants.map(|(t_ms, next)| curves::value_at(self.rows, *next, signal, *t_ms)).collect()
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
            let hidden = || curves::points(between, signal).filter(|(t_ms, _)| !instants.contains(t_ms));
            let range = |(low, high): (f64, f64), value: &f64| (low.min(*value), high.max(*value));
            let (low, high) = values.iter().flatten().fold((f64::INFINITY, f64::NEG_INFINITY), range);
            if hidden().all(|(_, value)| (low..=high).contains(&value)) {
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
    let inside = curves::points_between(rows, Column::Setpoint, window.from_ms, window.to_ms).map(|(t_ms, _)| t_ms);
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

    fn rows(count: u32, value: impl Fn(u32) -> f64) -> Vec<Row> {
        let row = |n: u32| Row { t_s: f64::from(n) * 1e-4, amplitude_um: value(n), ..Row::default() };
        (0..=count).map(row).collect()
    }

    const WHOLE: TimeWindow = TimeWindow { from_ms: 0.0, to_ms: 100.0 };

    #[test]
    fn every_row_keeps_its_instant_if_they_fit() {
        let rows = rows(10, f64::from);
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
        let rows = rows(1_000, |n| if n == 617 { 9.0 } else { 1.0 });
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
        let rows = rows(1_000, f64::from);
        let response = TimeWindow { from_ms: 10.0, to_ms: 20.0 };
        let grid = TimeGrid::new(&rows, WHOLE, Some(response), 100);
        let inside = grid.t_ms.iter().filter(|t_ms| (10.0..=20.0).contains(*t_ms)).count();
        assert!((48..=52).contains(&inside) && grid.t_ms.len() <= 100, "{inside} of {}", grid.t_ms.len());
        assert!(grid.t_ms.is_sorted_by(|a, b| a < b));
        assert_eq!((grid.t_ms[0], *grid.t_ms.last().unwrap()), (0.0, 100.0));
    }

    #[test]
    fn a_short_trial_leaves_a_gap() {
        let (long, short) = (rows(1_000, f64::from), rows(500, f64::from));
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
