//! Tolerance tubes around golden curves.
//!
//! A response is compared with a curve that was accepted once. Not row by row: a step that comes a hair later would be wrong by its whole height. At every
//! instant of the golden grid the response has to lie within a tolerance of the golden curve somewhere between that much earlier and that much later. The
//! tolerance has an absolute part, without which a signal near zero would have none, and a relative one.
//!
//! Between two points every curve is a straight line, also of what is held in truth: a jump is a steep line from one row to the next.

use platebench_trace::Row;
use serde::{Deserialize, Serialize};

/// A column that is compared.
#[derive(Debug)]
pub struct Signal {
    /// Its name in a trace.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// Its value in a row.
    pub of: fn(&Row) -> f64,
    /// How far it may be off unless a baseline says otherwise.
    pub tolerance: Tolerance,
    /// Decimals that it is written with: a thousandth of the absolute tolerance, or finer.
    pub decimals: usize,
}

/// How far a signal may be off.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tolerance {
    /// In the signal's unit.
    pub absolute: f64,
    /// Share of the golden value.
    pub relative: f64,
    /// Earlier or later, ms.
    pub time_ms: f64,
}

const VIBRATION: Tolerance = Tolerance { absolute: 0.01, relative: 0.005, time_ms: 0.05 };
const DRIVE: Tolerance = Tolerance { absolute: 3.0, relative: 0.01, time_ms: 0.05 };
const FREQUENCY: Tolerance = Tolerance { absolute: 0.5, relative: 0.0, time_ms: 0.05 };

/// Everything that is compared.
pub const SIGNALS: [Signal; 5] = [
    Signal { name: "amplitude_um", unit: "µm", of: |row| row.amplitude_um, tolerance: VIBRATION, decimals: 5 },
    Signal { name: "wd_um", unit: "µm", of: |row| row.wd_um, tolerance: VIBRATION, decimals: 5 },
    Signal { name: "wq_um", unit: "µm", of: |row| row.wq_um, tolerance: VIBRATION, decimals: 5 },
    Signal { name: "drive_vpp", unit: "Vpp", of: |row| row.drive_vpp, tolerance: DRIVE, decimals: 2 },
    Signal { name: "frequency_hz", unit: "Hz", of: |row| row.frequency_hz, tolerance: FREQUENCY, decimals: 3 },
];

impl Signal {
    /// The signal of that name.
    pub fn named(name: &str) -> Option<&'static Self> {
        SIGNALS.iter().find(|signal| signal.name == name)
    }
}

/// A point of a golden curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// When, ms.
    pub t_ms: f64,
    /// What was accepted.
    pub value: f64,
    /// What is allowed beside the tolerance, as learned from trials that differ; 0 where nothing was.
    pub width: f64,
}

/// A golden curve with its tolerance.
#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    /// Name of the signal.
    pub signal: String,
    /// Around the curve.
    pub tolerance: Tolerance,
    /// At least one, in the order of time.
    pub points: Vec<Point>,
}

/// Where a response leaves its tube the farthest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Exceedance {
    /// Name of the signal.
    pub signal: String,
    /// When, ms.
    pub t_ms: f64,
    /// What it was.
    pub value: f64,
    /// What it was when it was accepted.
    pub golden: f64,
    /// How far outside the tube's edge.
    pub distance: f64,
    /// Half the height of the tube there.
    pub allowed: f64,
}

impl Exceedance {
    /// How far off in units of what is allowed: above 1.
    pub fn severity(&self) -> f64 {
        1.0 + self.distance / self.allowed
    }
}

impl Tube {
    /// The first and the last instant, ms.
    pub fn span_ms(&self) -> (f64, f64) {
        (self.points.first().map_or(0.0, |point| point.t_ms), self.points.last().map_or(0.0, |point| point.t_ms))
    }

    /// The golden curve at an instant; at its ends beyond them.
    pub fn at(&self, t_ms: f64) -> Point {
        let next = self.points.partition_point(|point| point.t_ms <= t_ms);
        let ends = (next.checked_sub(1).and_then(|index| self.points.get(index)), self.points.get(next));
        match ends {
            (Some(left), Some(right)) => {
                let share = (t_ms - left.t_ms) / (right.t_ms - left.t_ms);
                let mix = |from: f64, to: f64| from + (to - from) * share;
                Point { t_ms, value: mix(left.value, right.value), width: mix(left.width, right.width) }
            }
            (Some(only), None) | (None, Some(only)) => Point { t_ms, ..*only },
            (None, None) => Point { t_ms, value: 0.0, width: 0.0 },
        }
    }

    /// Half the height of the tube at a point, without its tolerance in time.
    pub fn half(&self, point: Point) -> f64 {
        self.tolerance.absolute + self.tolerance.relative * point.value.abs() + point.width
    }

    /// The lower and the upper edge at an instant: the curve from that much earlier to that much later, with its tolerance around it.
    pub fn edges(&self, t_ms: f64) -> [f64; 2] {
        let (from, to) = (t_ms - self.tolerance.time_ms, t_ms + self.tolerance.time_ms);
        let start = self.points.partition_point(|point| point.t_ms <= from);
        let end = self.points.partition_point(|point| point.t_ms < to);
        let inside = self.points.get(start..end).unwrap_or_default().iter().copied();
        // On a line between two points the edges are the farthest out at one of them.
        let around = inside.chain([self.at(from), self.at(t_ms), self.at(to)]);
        around.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], point| {
            let half = self.half(point);
            [low.min(point.value - half), high.max(point.value + half)]
        })
    }

    /// The instants at which a response is looked at: every `step_ms` where there is one, and every point of the curve.
    fn grid(&self, step_ms: Option<f64>) -> impl Iterator<Item = f64> + '_ {
        let (from, to) = self.span_ms();
        let steps = step_ms.filter(|step| *step > 0.0).map_or(0, |step| ((to - from) / step).floor() as u64);
        let step = step_ms.unwrap_or_default();
        (0..=steps).map(move |index| from + index as f64 * step).chain(self.points.iter().map(|point| point.t_ms))
    }

    /// Where `response` (ms, value; in the order of time) leaves the tube the farthest; `None` where it stays inside.
    pub fn worst(&self, response: &[(f64, f64)], step_ms: Option<f64>) -> Option<Exceedance> {
        let outside = self.grid(step_ms).filter_map(|t_ms| {
            let value = value_at(response, t_ms)?;
            let [low, high] = self.edges(t_ms);
            let distance = (low - value).max(value - high);
            // A number that is none is outside, too.
            if distance <= 0.0 {
                return None;
            }
            let golden = self.at(t_ms);
            let (signal, allowed) = (self.signal.clone(), self.half(golden));
            Some(Exceedance { signal, t_ms, value, golden: golden.value, distance, allowed })
        });
        outside.reduce(|worst, other| if other.severity() > worst.severity() { other } else { worst })
    }
}

/// A response at an instant; `None` before its start and after its end.
fn value_at(response: &[(f64, f64)], t_ms: f64) -> Option<f64> {
    let next = response.partition_point(|(t, _)| *t <= t_ms);
    let (left, before) = *response.get(next.checked_sub(1)?)?;
    match response.get(next) {
        Some((right, after)) => Some(before + (after - before) * (t_ms - left) / (right - left)),
        None => (left == t_ms).then_some(before),
    }
}

/// A signal of a trace: ms and value.
pub fn response(signal: &Signal, rows: &[Row]) -> Vec<(f64, f64)> {
    rows.iter().map(|row| (row.t_s * 1e3, (signal.of)(row))).collect()
}

#[cfg(test)]
mod tests;
