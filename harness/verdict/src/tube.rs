//! Compares a response with a golden curve and its tolerance.
//!
//! A comparison row by row would fail a slightly later step by its whole height. Therefore, at
//! every instant of the golden grid, the response must be within the tolerance of the golden curve
//! at some time within the tolerance in time. Curves are linear between points.

use platebench_model::trace::{Column, Row};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug)]
pub struct TubeSignal {
    pub column: Column,
    pub unit: &'static str,
    pub tolerance: Tolerance,
    /// Decimals of values in files: the rounding is at most a thousandth of the absolute tolerance.
    pub decimals: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tolerance {
    /// Tolerance in the signal's unit.
    pub absolute: f64,
    /// Tolerance as a share of the golden value.
    pub relative: f64,
    pub time_ms: f64,
}

const VIBRATION: Tolerance = Tolerance { absolute: 0.01, relative: 0.005, time_ms: 0.05 };
const DRIVE: Tolerance = Tolerance { absolute: 3.0, relative: 0.01, time_ms: 0.05 };
const FREQUENCY: Tolerance = Tolerance { absolute: 0.5, relative: 0.0, time_ms: 0.05 };

pub const TUBE_SIGNALS: [TubeSignal; 5] = [
    TubeSignal { column: Column::Amplitude, unit: "µm", tolerance: VIBRATION, decimals: 5 },
    TubeSignal { column: Column::Wd, unit: "µm", tolerance: VIBRATION, decimals: 5 },
    TubeSignal { column: Column::Wq, unit: "µm", tolerance: VIBRATION, decimals: 5 },
    TubeSignal { column: Column::Drive, unit: "Vpp", tolerance: DRIVE, decimals: 2 },
    TubeSignal { column: Column::Frequency, unit: "Hz", tolerance: FREQUENCY, decimals: 3 },
];

impl TubeSignal {
    pub const fn name(&self) -> &'static str {
        self.column.name()
    }

    pub fn from_name(name: &str) -> Option<&'static Self> {
        TUBE_SIGNALS.iter().find(|signal| signal.name() == name)
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TubePoint {
    pub t_ms: f64,
    pub value: f64,
    /// Learned addition to the tolerance; 0 if the tube was not learned.
    pub width: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    pub signal: String,
    pub tolerance: Tolerance,
    /// Points in order of time; at least one.
    pub points: Vec<TubePoint>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Exceedance {
    pub signal: String,
    pub t_ms: f64,
    /// `null` if not finite, as is the distance.
    #[schemars(with = "Option<f64>")]
    pub value: f64,
    pub golden: f64,
    #[schemars(with = "Option<f64>")]
    pub distance: f64,
    /// Half the height of the tube at this instant.
    pub allowed: f64,
}

impl Exceedance {
    /// Deviation divided by the allowed deviation; above 1.
    pub fn ratio(&self) -> f64 {
        1.0 + self.distance / self.allowed
    }

    /// Returns the exceedance with the largest ratio; of equal ones, the first.
    pub(crate) fn worst(all: impl Iterator<Item = Self>) -> Option<Self> {
        all.reduce(|worst, other| if other.ratio() > worst.ratio() { other } else { worst })
    }
}

impl Tube {
    pub fn span_ms(&self) -> (f64, f64) {
        (self.points.first().map_or(0.0, |point| point.t_ms), self.points.last().map_or(0.0, |point| point.t_ms))
    }

    /// The curve is constant beyond its ends.
    pub fn point_at(&self, t_ms: f64) -> TubePoint {
        let next = self.points.partition_point(|point| point.t_ms <= t_ms);
        let ends = (next.checked_sub(1).and_then(|index| self.points.get(index)), self.points.get(next));
        match ends {
            (Some(left), Some(right)) => {
                let share = (t_ms - left.t_ms) / (right.t_ms - left.t_ms);
                let mix = |from: f64, to: f64| from + (to - from) * share;
                TubePoint { t_ms, value: mix(left.value, right.value), width: mix(left.width, right.width) }
            }
            (Some(only), None) | (None, Some(only)) => TubePoint { t_ms, ..*only },
            (None, None) => TubePoint { t_ms, value: 0.0, width: 0.0 },
        }
    }

    /// Half height without the tolerance in time.
    pub fn half_height(&self, point: TubePoint) -> f64 {
        self.tolerance.absolute + self.tolerance.relative * point.value.abs() + point.width
    }

    /// Lowest and highest edge within the tolerance in time around `t_ms`.
    pub fn edges(&self, t_ms: f64) -> [f64; 2] {
        let (from, to) = (t_ms - self.tolerance.time_ms, t_ms + self.tolerance.time_ms);
        let start = self.points.partition_point(|point| point.t_ms <= from);
        let end = self.points.partition_point(|point| point.t_ms < to);
        let inside = self.points.get(start..end).unwrap_or_default().iter().copied();
        // The edges are linear between points, so their extremes are at one of these points.
        let around = inside.chain([self.point_at(from), self.point_at(t_ms), self.point_at(to)]);
        around.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], point| {
            let half = self.half_height(point);
            [low.min(point.value - half), high.max(point.value + half)]
        })
    }

    fn comparison_instants(&self, step_ms: Option<f64>) -> impl Iterator<Item = f64> + '_ {
        let (from, to) = self.span_ms();
        let steps = step_ms.filter(|step| *step > 0.0).map_or(0, |step| ((to - from) / step).floor() as u64);
        let step = step_ms.unwrap_or_default();
        (0..=steps).map(move |index| from + index as f64 * step).chain(self.points.iter().map(|point| point.t_ms))
    }

    /// `response` contains (ms, value) in order of time. `None` if the response is inside the tube.
    pub fn worst_exceedance(&self, response: &[(f64, f64)], step_ms: Option<f64>) -> Option<Exceedance> {
        let outside = self.comparison_instants(step_ms).filter_map(|t_ms| {
            let value = value_at(response, t_ms)?;
            let [low, high] = self.edges(t_ms);
            let distance = (low - value).max(value - high);
            // NaN counts as outside.
            if distance <= 0.0 {
                return None;
            }
            let golden = self.point_at(t_ms);
            let (signal, allowed) = (self.signal.clone(), self.half_height(golden));
            Some(Exceedance { signal, t_ms, value, golden: golden.value, distance, allowed })
        });
        Exceedance::worst(outside)
    }
}

/// `None` before the start and after the end of the response.
fn value_at(response: &[(f64, f64)], t_ms: f64) -> Option<f64> {
    let next = response.partition_point(|(t, _)| *t <= t_ms);
    let (left, before) = *response.get(next.checked_sub(1)?)?;
    match response.get(next) {
        Some((right, after)) => Some(before + (after - before) * (t_ms - left) / (right - left)),
        None => (left == t_ms).then_some(before),
    }
}

pub fn signal_response(signal: &TubeSignal, rows: &[Row]) -> Vec<(f64, f64)> {
    rows.iter().map(|row| (row.t_s * 1e3, signal.column.value(row))).collect()
}

#[cfg(test)]
mod tests;
