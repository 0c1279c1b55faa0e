//! Rows to curves that a plot can hold: a few hundred points that lose no peak.
//!
//! Neighbours: `bundle` reads traces and calls this, `figure` decides which curves stand together. Nothing is measured
//! here.

use platebench_trace::{Flags, Row};
use platebench_verdict::metrics::setpoint_steps;

/// Milliseconds and a value.
pub(crate) type Point = (f64, f64);

/// What is plotted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Signal {
    Amplitude,
    InPhase,
    Quadrature,
    Setpoint,
    Drive,
    Frequency,
    Resonance,
    Force,
    Temperature,
}

impl Signal {
    pub(crate) const ALL: [Self; 9] = [
        Self::Amplitude,
        Self::InPhase,
        Self::Quadrature,
        Self::Setpoint,
        Self::Drive,
        Self::Frequency,
        Self::Resonance,
        Self::Force,
        Self::Temperature,
    ];

    fn of(self, row: &Row) -> f64 {
        match self {
            Self::Amplitude => row.amplitude_um,
            Self::InPhase => row.wd_um,
            Self::Quadrature => row.wq_um,
            Self::Setpoint => row.setpoint_um,
            Self::Drive => row.drive_vpp,
            Self::Frequency => row.frequency_hz,
            Self::Resonance => row.resonance_hz,
            Self::Force => row.finger_force_n,
            Self::Temperature => row.temperature_offset_k,
        }
    }

    /// What is applied stays until the next row; the plate moves on between rows.
    pub(crate) fn is_held(self) -> bool {
        matches!(self, Self::Setpoint | Self::Drive | Self::Frequency)
    }
}

/// A stretch of a trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Window {
    pub(crate) from_ms: f64,
    pub(crate) to_ms: f64,
}

impl Window {
    pub(crate) fn span_ms(self) -> f64 {
        self.to_ms - self.from_ms
    }

    /// The edges of bucket `number` of `buckets`.
    fn bucket(self, number: usize, buckets: usize) -> (f64, f64) {
        let edge = |number: usize| self.from_ms + self.span_ms() * number as f64 / buckets as f64;
        (edge(number), edge(number + 1))
    }
}

fn ms(row: &Row) -> f64 {
    row.t_s * 1e3
}

/// The rows after `from_ms` up to `to_ms`, inclusive.
fn between(rows: &[Row], from_ms: f64, to_ms: f64) -> &[Row] {
    let start = rows.partition_point(|row| ms(row) <= from_ms);
    let end = rows.partition_point(|row| ms(row) <= to_ms);
    rows.get(start..end).unwrap_or_default()
}

/// The signal at the rows after `from_ms` up to `to_ms`, inclusive.
pub(crate) fn points_between(rows: &[Row], signal: Signal, from_ms: f64, to_ms: f64) -> impl Iterator<Item = Point> {
    between(rows, from_ms, to_ms).iter().map(move |row| (ms(row), signal.of(row)))
}

/// The signal at an instant; `None` before the first row and after the last.
pub(crate) fn value_at(rows: &[Row], signal: Signal, at_ms: f64) -> Option<f64> {
    let next = rows.partition_point(|row| ms(row) <= at_ms);
    let before = rows.get(next.checked_sub(1)?)?;
    let Some(after) = rows.get(next) else { return (ms(before) == at_ms).then(|| signal.of(before)) };
    if signal.is_held() {
        return Some(signal.of(before));
    }
    let share = (at_ms - ms(before)) / (ms(after) - ms(before));
    Some(signal.of(before) + (signal.of(after) - signal.of(before)) * share)
}

/// A line of the signal at an instant; `None` before its first point and after its last.
pub(crate) fn on_line(points: &[Point], signal: Signal, at_ms: f64) -> Option<f64> {
    let next = points.partition_point(|point| point.0 <= at_ms);
    let (before, after) = (points.get(next.checked_sub(1)?)?, points.get(next));
    let Some(after) = after else { return (before.0 == at_ms).then_some(before.1) };
    if signal.is_held() {
        return Some(before.1);
    }
    Some(before.1 + (after.1 - before.1) * (at_ms - before.0) / (after.0 - before.0))
}

/// The signal in the window as a line of at most some `limit` points.
pub(crate) fn line(rows: &[Row], signal: Signal, window: Window, limit: usize) -> Vec<Point> {
    let mut points: Vec<Point> = Vec::new();
    let edge = |at_ms| value_at(rows, signal, at_ms).map(|value| (at_ms, value));
    points.extend(edge(window.from_ms));
    let mut end = None;
    for point in between(rows, window.from_ms, window.to_ms).iter().map(|row| (ms(row), signal.of(row))) {
        end = Some(point);
        match points.last() {
            Some((_, before)) if signal.is_held() && *before == point.1 => continue,
            Some((_, before)) if signal.is_held() => points.push((point.0, *before)),
            _ => {}
        }
        points.push(point);
    }
    points.extend(edge(window.to_ms).or(end));
    // Of a real plate not everything is known.
    points.retain(|(_, value)| value.is_finite());
    points.dedup();
    thin(&points, window, limit)
}

/// Lowest and highest point of each of `limit / 2` stretches of the window, in the order of time; the two ends stay.
pub(crate) fn thin(points: &[Point], window: Window, limit: usize) -> Vec<Point> {
    if points.len() <= limit {
        return points.to_vec();
    }
    let buckets = (limit / 2).max(1) as f64;
    let bucket = |point: &Point| ((point.0 - window.from_ms) / window.span_ms() * buckets).floor();
    let mut thinned: Vec<Point> = points.first().copied().into_iter().collect();
    for part in points.chunk_by(|a, b| bucket(a) == bucket(b)) {
        let by_value = |a: &&Point, b: &&Point| a.1.total_cmp(&b.1);
        let extremes = [part.iter().min_by(by_value), part.iter().max_by(by_value)];
        let mut extremes: Vec<Point> = extremes.into_iter().flatten().copied().collect();
        extremes.sort_by(|a, b| a.0.total_cmp(&b.0));
        thinned.extend(extremes);
    }
    thinned.extend(points.last());
    thinned.dedup();
    thinned
}

/// Lowest and highest value over trials, by stretch of time.
#[derive(Debug, Clone)]
pub(crate) struct Envelope {
    window: Window,
    held: bool,
    range: Vec<Option<(f64, f64)>>,
    trials: usize,
    differs: bool,
}

impl Envelope {
    /// Over `buckets` stretches of `window`.
    pub(crate) fn new(window: Window, signal: Signal, buckets: usize) -> Self {
        Self { window, held: signal.is_held(), range: vec![None; buckets], trials: 0, differs: false }
    }

    /// Takes a trial in.
    pub(crate) fn widen(&mut self, rows: &[Row], signal: Signal) {
        let buckets = self.range.len();
        for (number, range) in self.range.iter_mut().enumerate() {
            let (from_ms, to_ms) = self.window.bucket(number, buckets);
            let edges = [value_at(rows, signal, from_ms), value_at(rows, signal, to_ms)];
            let inside = between(rows, from_ms, to_ms).iter().map(|row| signal.of(row));
            for value in edges.into_iter().flatten().chain(inside) {
                let (low, high) = range.unwrap_or((value, value));
                if self.trials > 0 && !(low..=high).contains(&value) {
                    self.differs = true;
                }
                *range = Some((low.min(value), high.max(value)));
            }
        }
        self.trials += 1;
    }

    /// Upper and lower edge, both from left to right; `None` where all trials are the same.
    pub(crate) fn edges(&self) -> Option<[Vec<Point>; 2]> {
        if !self.differs {
            return None;
        }
        let mut edges = [Vec::new(), Vec::new()];
        for (number, (low, high)) in self.range.iter().enumerate().filter_map(|(n, range)| Some((n, (*range)?))) {
            let (from_ms, to_ms) = self.window.bucket(number, self.range.len());
            for (edge, value) in edges.iter_mut().zip([high, low]) {
                if self.held {
                    edge.extend([(from_ms, value), (to_ms, value)]);
                } else {
                    edge.push((f64::midpoint(from_ms, to_ms), value));
                }
            }
        }
        Some(edges)
    }
}

/// The stretches in which one of `flags` is set: the drive at the amplifier's limit, the link lost.
pub(crate) fn flagged(rows: &[Row], window: Window, flags: Flags) -> Vec<Window> {
    let mut spans: Vec<Window> = Vec::new();
    for pair in rows.windows(2) {
        let [row, next] = pair else { continue };
        let (from_ms, to_ms) = (ms(row).max(window.from_ms), ms(next).min(window.to_ms));
        if row.flags.intersects(flags) && from_ms < to_ms {
            spans.push(Window { from_ms, to_ms });
        }
    }
    merged(spans)
}

/// The instants for which the bench was too late.
pub(crate) fn overruns(rows: &[Row]) -> impl Iterator<Item = f64> {
    rows.iter().filter(|row| row.flags.contains(Flags::OVERRUN)).map(ms)
}

/// Stretches that touch or overlap as one.
pub(crate) fn merged(mut spans: Vec<Window>) -> Vec<Window> {
    spans.sort_by(|a, b| a.from_ms.total_cmp(&b.from_ms));
    let mut result: Vec<Window> = Vec::new();
    for span in spans {
        match result.last_mut() {
            Some(last) if span.from_ms <= last.to_ms => last.to_ms = last.to_ms.max(span.to_ms),
            _ => result.push(span),
        }
    }
    result
}

/// The instants at which the setpoint starts to move, as the judge sees them.
pub(crate) fn steps_ms(rows: &[Row]) -> Vec<f64> {
    setpoint_steps(rows).into_iter().filter_map(|step| rows.get(step).map(ms)).collect()
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

    const POINTS: usize = 400;
    const BUCKETS: usize = 200;
    const ALL: Window = Window { from_ms: 0.0, to_ms: 4.0 };

    #[test]
    fn the_plate_moves_between_rows_and_the_drive_stays() {
        let rows = rows(&[(0.0, 0.0), (2.0, 4.0), (4.0, 4.0)]);
        assert_eq!(value_at(&rows, Signal::Amplitude, 1.0), Some(2.0));
        assert_eq!(value_at(&rows, Signal::Drive, 1.0), Some(0.0));
        assert_eq!(value_at(&rows, Signal::Drive, 4.5), None);
        assert_eq!(line(&rows, Signal::Drive, ALL, POINTS), [(0.0, 0.0), (2.0, 0.0), (2.0, 4.0), (4.0, 4.0)]);
        let middle = Window { from_ms: 1.0, to_ms: 3.0 };
        assert_eq!(line(&rows, Signal::Amplitude, middle, POINTS), [(1.0, 2.0), (2.0, 4.0), (3.0, 4.0)]);
    }

    #[test]
    fn a_line_of_points_runs_as_its_signal_does() {
        let points = [(0.0, 0.0), (2.0, 4.0)];
        let at = |signal, at_ms| on_line(&points, signal, at_ms);
        assert_eq!((at(Signal::Amplitude, 1.0), at(Signal::Drive, 1.0)), (Some(2.0), Some(0.0)));
        assert_eq!((at(Signal::Drive, 2.0), at(Signal::Drive, 2.1), at(Signal::Drive, -0.1)), (Some(4.0), None, None));
    }

    #[test]
    fn thinning_keeps_a_single_peak() {
        let mut many: Vec<Point> = (0..60_000).map(|n| (f64::from(n) * 4.0 / 60_000.0, 1.0)).collect();
        many[31_234].1 = 9.0;
        let thinned = thin(&many, ALL, POINTS);
        assert!(thinned.len() <= POINTS + 2, "{}", thinned.len());
        assert!(thinned.contains(&many[31_234]));
        assert!(thinned.is_sorted_by(|a, b| a.0 <= b.0));
    }

    #[test]
    fn an_envelope_holds_every_trial_and_equal_trials_have_none() {
        let low = rows(&[(0.0, 1.0), (4.0, 1.0)]);
        let high = rows(&[(0.0, 1.0), (1.0, 3.0), (1.01, 1.0), (4.0, 1.0)]);
        let mut envelope = Envelope::new(ALL, Signal::Amplitude, BUCKETS);
        envelope.widen(&low, Signal::Amplitude);
        envelope.widen(&low, Signal::Amplitude);
        assert!(envelope.edges().is_none());
        envelope.widen(&high, Signal::Amplitude);
        let [upper, lower] = envelope.edges().unwrap();
        assert_eq!(upper.iter().map(|point| point.1).fold(0.0, f64::max), 3.0);
        assert_eq!(lower.iter().map(|point| point.1).fold(9.0, f64::min), 1.0);
        assert_eq!(upper.len(), BUCKETS);
    }

    #[test]
    fn a_ramp_is_one_step_and_equal_instants_are_one() {
        let steps =
            steps_ms(&rows(&[(0.0, 0.0), (1.0, 0.0), (1.0, 2.0), (2.0, 2.0), (3.0, 2.5), (3.5, 3.0), (4.0, 3.0)]));
        // A ramp begins at the row before the first that differs.
        assert_eq!(steps, [1.0, 2.0]);
        assert_eq!(steps_ms(&rows(&[(0.0, 2.0), (1.0, 2.0)])), [0.0]);
    }

    #[test]
    fn saturation_lasts_until_the_next_row() {
        let mut rows = rows(&[(0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (3.0, 1.0)]);
        rows[1].flags = Flags::SATURATED | Flags::CONTROL;
        rows[2].flags = Flags::SATURATED;
        assert_eq!(flagged(&rows, ALL, Flags::SATURATED), [Window { from_ms: 1.0, to_ms: 3.0 }]);
    }
}
