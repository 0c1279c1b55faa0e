//! Compares trials with golden curves (`docs/verdicts.md`).

use crate::statistics::probability_at_least;
use crate::tube::{Exceedance, TUBE_SIGNALS, Tube, TubePoint, TubeSignal, signal_response};
use platebench_model::record::Verdict;
use platebench_model::trace::Row;
use schemars::JsonSchema;
use serde::Serialize;

const SIGNIFICANCE_LEVEL: f64 = 0.05;
const PROBABILITY_ROUNDING: f64 = 1e-12;
/// Both instants of a step are rounded to nanoseconds.
const INSTANT_ROUNDING_MS: f64 = 1.5e-6;

#[derive(Debug, Clone, PartialEq)]
pub struct GoldenTubes {
    pub tubes: Vec<Tube>,
    /// Spacing of instants that are compared in addition to those of the curves.
    pub step_ms: Option<f64>,
    /// Share of trials of an unchanged controller that leave a learned tube; `None` if the tube was
    /// not learned.
    pub false_alarm_rate: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TubeMatch {
    Inside,
    Outside(Exceedance),
    Length {
        /// First and last instant.
        trial_ms: [f64; 2],
        golden_ms: [f64; 2],
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct TubeComparison {
    pub verdict: Verdict,
    pub trials: usize,
    pub outside: usize,
    pub worst: Option<(u32, Exceedance)>,
    pub reason: Option<String>,
}

/// Largest time between two rows, ms; 0 if there are fewer than two.
pub fn row_step_ms(rows: &[Row]) -> f64 {
    largest_step(rows.iter().map(|row| row.t_s * 1e3))
}

/// First time between two rows that is longer than `step_ms`, as start and end in ms.
pub fn gap_between_rows(rows: &[Row], step_ms: f64) -> Option<[f64; 2]> {
    first_gap(rows.iter().map(|row| row.t_s * 1e3), step_ms)
}

fn largest_step(instants: impl Iterator<Item = f64> + Clone) -> f64 {
    instants.clone().zip(instants.skip(1)).map(|(left, right)| right - left).fold(0.0, f64::max)
}

fn first_gap(instants: impl Iterator<Item = f64> + Clone, step_ms: f64) -> Option<[f64; 2]> {
    let is_gap = |(left, right): &(f64, f64)| right - left > step_ms + INSTANT_ROUNDING_MS;
    instants.clone().zip(instants.skip(1)).find(is_gap).map(|(left, right)| [left, right])
}

impl GoldenTubes {
    /// Creates tubes with the default tolerances. `None` if `rows` cover no time range.
    pub fn from_rows(rows: &[Row]) -> Option<Self> {
        let point = |(t_ms, value)| TubePoint { t_ms, value, width: 0.0 };
        let tube = |signal: &TubeSignal| Tube {
            signal: signal.name().to_owned(),
            tolerance: signal.tolerance,
            points: signal_response(signal, rows).into_iter().map(point).collect(),
        };
        (row_step_ms(rows) > 0.0).then(|| Self {
            tubes: TUBE_SIGNALS.iter().map(tube).collect(),
            step_ms: None,
            false_alarm_rate: None,
        })
    }

    /// Largest time between two rows of the reference, ms.
    pub fn row_step_ms(&self) -> f64 {
        let points = self.tubes.first().map(|tube| tube.points.as_slice()).unwrap_or_default();
        self.step_ms.unwrap_or_else(|| largest_step(points.iter().map(|point| point.t_ms)))
    }

    /// First time between two points of the reference that is longer than `step_ms`, as start and
    /// end in ms. `None` if unnecessary points were removed.
    pub fn gap(&self, step_ms: f64) -> Option<[f64; 2]> {
        let points = self.tubes.first().filter(|_| self.step_ms.is_none())?.points.iter();
        first_gap(points.map(|point| point.t_ms), step_ms)
    }

    /// The worst exceedance of each signal that leaves its tube.
    pub fn exceedances(&self, rows: &[Row]) -> Vec<Exceedance> {
        let worst = |tube: &Tube| {
            let signal = TubeSignal::from_name(&tube.signal)?;
            tube.worst_exceedance(&signal_response(signal, rows), self.step_ms)
        };
        self.tubes.iter().filter_map(worst).collect()
    }

    pub fn match_trial(&self, rows: &[Row]) -> TubeMatch {
        if let Some(worst) = Exceedance::worst(self.exceedances(rows).into_iter()) {
            return TubeMatch::Outside(worst);
        }
        let ms = |row: Option<&Row>| row.map_or(f64::NAN, |row| row.t_s * 1e3);
        let trial_ms = [ms(rows.first()), ms(rows.last())];
        let other_length = self.tubes.iter().find(|tube| {
            let (from, to) = tube.span_ms();
            // Instants are rounded to nanoseconds, so 0.5 ns is tolerated.
            let near = |one: f64, other: f64| (one - other).abs() <= tube.tolerance.time_ms + 0.5e-6;
            !(near(from, trial_ms[0]) && near(to, trial_ms[1]))
        });
        match other_length {
            Some(tube) => TubeMatch::Length { trial_ms, golden_ms: [tube.span_ms().0, tube.span_ms().1] },
            None => TubeMatch::Inside,
        }
    }

    /// A learned tube fails if at least this many trials outside have a probability of at most 5 %.
    pub fn compare<R: AsRef<[Row]>>(&self, trials: impl IntoIterator<Item = (u32, R)>) -> TubeComparison {
        let mut comparison =
            TubeComparison { verdict: Verdict::Inconclusive, trials: 0, outside: 0, worst: None, reason: None };
        let mut other_length = None;
        for (index, rows) in trials {
            comparison.trials += 1;
            match self.match_trial(rows.as_ref()) {
                TubeMatch::Inside => {}
                TubeMatch::Outside(found) => {
                    comparison.outside += 1;
                    let is_worst = comparison.worst.as_ref().is_none_or(|(_, worst)| found.ratio() > worst.ratio());
                    if is_worst {
                        comparison.worst = Some((index, found));
                    }
                }
                TubeMatch::Length { trial_ms: [from, to], golden_ms: [begin, end] } => {
                    other_length.get_or_insert_with(|| {
                        format!(
                            "trial {index} has rows from {from} to {to} ms, expected those of the baseline, from \
                             {begin} to {end} ms"
                        )
                    });
                }
            }
        }
        let (verdict, reason) = self.decide_verdict(&comparison, other_length);
        TubeComparison { verdict, reason, ..comparison }
    }

    fn decide_verdict(&self, comparison: &TubeComparison, other_length: Option<String>) -> (Verdict, Option<String>) {
        let (outside, trials) = (comparison.outside as u32, comparison.trials as u32);
        let rate = self.false_alarm_rate.unwrap_or(0.0);
        let expected = rate * f64::from(trials);
        let summary = match self.false_alarm_rate {
            Some(_) => {
                format!("{outside} of {trials} trials are outside the tube; {expected:.1} are expected by chance")
            }
            None => format!("{outside} of {trials} trials are outside the tube"),
        };
        if trials == 0 {
            (Verdict::Inconclusive, Some("no trial to compare".to_owned()))
        } else if outside > 0
            && probability_at_least(outside, trials, rate) <= SIGNIFICANCE_LEVEL + PROBABILITY_ROUNDING
        {
            (Verdict::Fail, Some(summary))
        } else if f64::from(outside) > expected {
            (Verdict::Inconclusive, Some(summary))
        } else if other_length.is_some() {
            (Verdict::Inconclusive, other_length)
        } else {
            (Verdict::Pass, None)
        }
    }
}

/// Largest error from removed points, as a share of the tolerance.
const TOLERANCE_SHARE: f64 = 0.1;

/// Removes points near the line between their neighbours, by the algorithm of D. H. Douglas and T.
/// K. Peucker (*Cartographica* 10, 1973, pp. 112-122). The distance is the difference in value at
/// one instant. All tubes keep the same instants.
pub(super) fn thin(tubes: &mut [Tube]) {
    let count = tubes.first().map_or(0, |tube| tube.points.len());
    let mut kept = vec![false; count];
    let mut open: Vec<(usize, usize)> = Vec::new();
    if let Some(last) = count.checked_sub(1) {
        for end in [0, last] {
            if let Some(kept) = kept.get_mut(end) {
                *kept = true;
            }
        }
        open.push((0, last));
    }
    while let Some((from, to)) = open.pop() {
        let farthest = (from + 1..to)
            .map(|index| (index, tubes.iter().map(|tube| relative_distance(tube, from, index, to)).fold(0.0, f64::max)))
            .reduce(|worst, other| if other.1 > worst.1 { other } else { worst });
        if let Some((index, _)) = farthest.filter(|(_, off)| *off > TOLERANCE_SHARE) {
            if let Some(kept) = kept.get_mut(index) {
                *kept = true;
            }
            open.extend([(from, index), (index, to)]);
        }
    }
    for tube in tubes {
        let mut stays = kept.iter();
        tube.points.retain(|_| stays.next().copied().unwrap_or(false));
    }
}

/// Distance of the point `index` from the line between `from` and `to`, in units of the tolerance.
fn relative_distance(tube: &Tube, from: usize, index: usize, to: usize) -> f64 {
    let [Some(left), Some(point), Some(right)] = [from, index, to].map(|at| tube.points.get(at)) else { return 0.0 };
    let length = right.t_ms - left.t_ms;
    let share = if length > 0.0 { (point.t_ms - left.t_ms) / length } else { 0.0 };
    let line = |of: fn(&TubePoint) -> f64| of(left) + (of(right) - of(left)) * share;
    let value = (line(|point| point.value) - point.value).abs();
    let width = (line(|point| point.width) - point.width).abs();
    value.max(width) / tube.half_height(*point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Tolerance;

    fn tube(value: impl Fn(f64) -> f64) -> Tube {
        let points = (0..=1_000).map(|index| f64::from(index) * 0.06);
        Tube {
            signal: "amplitude_um".to_owned(),
            tolerance: Tolerance { absolute: 0.01, relative: 0.0, time_ms: 0.0 },
            points: points.map(|t_ms| TubePoint { t_ms, value: value(t_ms), width: 0.0 }).collect(),
        }
    }

    #[test]
    fn keeps_the_curve() {
        let response = tube(|t| 2.0 * (1.0 - (-t / 1.88_f64).exp()));
        let jump = tube(|t| if t < 30.0 { 0.0 } else { 5.0 });
        let mut thinned = [response.clone(), jump.clone()];
        thin(&mut thinned);
        let [short, steep] = &thinned;
        assert!((10..60).contains(&short.points.len()), "{}", short.points.len());
        assert_eq!(short.points.len(), steep.points.len());
        for (before, after) in [(&response, short), (&jump, steep)] {
            for point in &before.points {
                assert!((after.point_at(point.t_ms).value - point.value).abs() <= 0.001 + 1e-12);
            }
        }
    }

    #[test]
    fn keeps_the_ends() {
        let mut flat = [tube(|_| 1.0)];
        thin(&mut flat);
        assert_eq!(flat[0].points.len(), 2);
        let mut empty = [Tube { points: Vec::new(), ..tube(|_| 1.0) }];
        thin(&mut empty);
        assert!(empty[0].points.is_empty());
    }
}
