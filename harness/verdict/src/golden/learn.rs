//! A tube from trials that differ.
//!
//! Split conformal prediction: a third of the trials gives the curve (their mean) and the shape of the tube (their deviation at each instant), the others say
//! how wide it has to be. Each of them has a score: the factor on the shape with which it just lies inside at every instant and in every signal. A trial to
//! come is as likely as any of the m others to have the highest score, so a tube at the r-th smallest score is left with probability `1 − r/(m + 1)` at most.
//! That holds whatever the distribution is, on average over the trials that were learned from.
//!
//! J. Lei, M. G'Sell, A. Rinaldo, R. J. Tibshirani, L. Wasserman, "Distribution-free predictive inference for regression", *J. Am. Stat. Assoc.* 113, 2018,
//! theorem 2; for curves: J. Diquigiovanni, M. Fontana, S. Vantini, *J. Multivar. Anal.* 189, 2022.

use super::Golden;
use super::thin::thin;
use crate::statistics::Summary;
use crate::tube::{Point, SIGNALS, Tube, response};
use platebench_trace::Row;

/// The shape is nowhere narrower than this share of where it is widest: a signal that never varied so far may do so a little.
const LEAST_SHAPE: f64 = 0.1;
/// The curve is a mean of at least so many trials.
const FEWEST_FOR_CURVE: usize = 3;
/// Halvings of the range of a score.
const HALVINGS: u32 = 40;
/// A score beyond all reason: the trials have nothing to do with each other.
const HIGHEST_SCORE: f64 = 1e6;

/// Why no tube can be learned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LearnError {
    /// So many trials cannot show so rare an event.
    #[error("a false-alarm rate of {rate} takes at least {needed} trials to learn from, there are {count}")]
    TooFew {
        /// The declared rate.
        rate: f64,
        /// How many there are.
        count: usize,
        /// How many it takes.
        needed: usize,
    },
    /// A trial is shorter or longer than another.
    #[error("trial {0} has other instants than the first one")]
    OtherInstants(usize),
    /// The trials have nothing to do with each other.
    #[error("the trials differ too much for a tube")]
    TooDifferent,
}

/// How many of `count` trials give the curve.
fn for_curve(count: usize) -> usize {
    (count / 3).max(FEWEST_FOR_CURVE)
}

/// How many trials a tube of that false-alarm rate takes.
fn needed(rate: f64) -> usize {
    // r = ⌈(m + 1)(1 − rate)⌉ ≤ m where m ≥ 1/rate − 1; beside them a third of all.
    let scores = ((1.0 / rate).ceil() as usize).saturating_sub(1).max(1);
    let most = scores.saturating_mul(2).saturating_add(FEWEST_FOR_CURVE);
    (scores..=most).find(|count| count.saturating_sub(for_curve(*count)) >= scores).unwrap_or(most)
}

impl Golden {
    /// A tube that a further trial leaves with probability `rate`, learned from trials on the same grid of instants every `step_ms`.
    ///
    /// # Errors
    /// [`LearnError`] where there are too few, or where they do not go together.
    pub fn learn(trials: &[Vec<Row>], step_ms: f64, rate: f64) -> Result<Self, LearnError> {
        let needed = needed(rate);
        if trials.len() < needed {
            return Err(LearnError::TooFew { rate, count: trials.len(), needed });
        }
        let end_ms = |rows: &Vec<Row>| rows.last().map_or(0.0, |row| row.t_s * 1e3);
        let end = trials.first().map_or(0.0, end_ms);
        if let Some(other) = trials.iter().position(|rows| rows.is_empty() || end_ms(rows) != end) {
            return Err(LearnError::OtherInstants(other));
        }
        let (curve, scored) = trials.split_at(for_curve(trials.len()));
        let mut tubes: Vec<Tube> = SIGNALS
            .iter()
            .map(|signal| {
                let curves: Vec<Tube> = curve
                    .iter()
                    .map(|rows| Tube {
                        signal: signal.name.to_owned(),
                        tolerance: signal.tolerance,
                        points: response(signal, rows)
                            .into_iter()
                            .map(|(t_ms, value)| Point { t_ms, value, width: 0.0 })
                            .collect(),
                    })
                    .collect();
                let steps = (end / step_ms).round() as u64;
                let points = (0..=steps).map(|index| {
                    let t_ms = (index as f64 * step_ms).min(end);
                    let values: Vec<f64> = curves.iter().map(|curve| curve.at(t_ms).value).collect();
                    let summary = Summary::of(&values);
                    Point {
                        t_ms,
                        value: summary.map_or(0.0, |of| of.mean),
                        width: summary.map_or(0.0, |of| of.deviation),
                    }
                });
                let mut points: Vec<Point> = points.collect();
                let widest = points.iter().map(|point| point.width).fold(0.0, f64::max);
                let least = (widest * LEAST_SHAPE).max(signal.tolerance.absolute * LEAST_SHAPE);
                for point in &mut points {
                    point.width = point.width.max(least);
                }
                Tube { signal: signal.name.to_owned(), tolerance: signal.tolerance, points }
            })
            .collect();
        thin(&mut tubes);
        let shape = Self { tubes, step_ms: Some(step_ms), false_alarm_rate: Some(rate) };
        let mut scores: Vec<f64> = scored.iter().map(|rows| shape.score(rows)).collect();
        scores.sort_by(f64::total_cmp);
        // What rounding makes of a rank that is whole must not take another trial.
        let rank = ((scores.len() + 1) as f64 * (1.0 - rate) - 1e-9).ceil() as usize;
        match rank.checked_sub(1).map_or(scores.first(), |index| scores.get(index)) {
            Some(score) if *score < HIGHEST_SCORE => Ok(shape.scaled(*score)),
            _ => Err(LearnError::TooDifferent),
        }
    }

    fn scaled(&self, factor: f64) -> Self {
        let mut scaled = self.clone();
        for point in scaled.tubes.iter_mut().flat_map(|tube| &mut tube.points) {
            point.width *= factor;
        }
        scaled
    }

    /// The factor on the shape with which a trial just lies inside.
    fn score(&self, rows: &[Row]) -> f64 {
        let is_inside = |factor: f64| {
            let scaled = self.scaled(factor);
            SIGNALS
                .iter()
                .zip(&scaled.tubes)
                .all(|(signal, tube)| tube.worst(&response(signal, rows), self.step_ms).is_none())
        };
        if is_inside(0.0) {
            return 0.0;
        }
        let mut high = 1.0;
        while !is_inside(high) {
            high *= 2.0;
            if high >= HIGHEST_SCORE {
                return f64::INFINITY;
            }
        }
        let mut low = if high > 1.0 { high / 2.0 } else { 0.0 };
        for _ in 0..HALVINGS {
            let middle = f64::midpoint(low, high);
            if is_inside(middle) { high = middle } else { low = middle }
        }
        high
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rstest::rstest;

    /// A response whose height and lateness differ from trial to trial, with noise on it.
    fn trial(random: &mut ChaCha8Rng) -> Vec<Row> {
        let mut normal = || -> f64 { StandardNormal.sample(random) };
        let (height, late) = (2.0 + 0.03 * normal(), 0.1 * normal());
        let rows = (0..=40).map(|index| {
            let t_ms = f64::from(index) * 0.5;
            let level = height * (1.0 - (-(t_ms - late).max(0.0) / 1.9).exp()) + 0.01 * normal();
            Row {
                t_s: t_ms / 1e3,
                amplitude_um: level,
                wd_um: level,
                drive_vpp: 300.0,
                frequency_hz: 32_307.6,
                ..Row::default()
            }
        });
        rows.collect()
    }

    fn trials(random: &mut ChaCha8Rng, count: usize) -> Vec<Vec<Row>> {
        (0..count).map(|_| trial(random)).collect()
    }

    /// On average over what was learned from, as declared: 1 − r/(m + 1) for m = 20 is 2/21 where r = 19 and 1/21 where r = 20.
    #[rstest]
    #[case(0.1, 2.0 / 21.0)]
    #[case(0.05, 1.0 / 21.0)]
    fn a_learned_tube_is_left_as_often_as_declared(#[case] rate: f64, #[case] expected: f64) {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        let (tubes, further) = (60, 50);
        let mut outside = 0_u32;
        for _ in 0..tubes {
            let golden = Golden::learn(&trials(&mut random, 29), 0.5, rate).unwrap();
            let tried = trials(&mut random, further);
            outside += golden.compare(tried.iter().map(|rows| (0, rows.as_slice()))).outside as u32;
        }
        let found = f64::from(outside) / (tubes * further) as f64;
        // Tubes differ: the rate of each is Beta distributed with a deviation of some 5 to 6 %, which 60 tubes bring down to 0.8 %.
        assert!((found - expected).abs() < 0.025, "{found}");
    }

    #[rstest]
    #[case(0.05, 28)]
    #[case(0.1, 13)]
    #[case(0.5, 4)]
    fn so_rare_an_alarm_takes_so_many_trials(#[case] rate: f64, #[case] fewest: usize) {
        assert_eq!(needed(rate), fewest);
        let all = trials(&mut ChaCha8Rng::seed_from_u64(1), fewest);
        assert!(Golden::learn(&all, 0.5, rate).is_ok());
        let error = Golden::learn(&all[1..], 0.5, rate).unwrap_err();
        assert_eq!(error, LearnError::TooFew { rate, count: fewest - 1, needed: fewest });
    }

    #[test]
    fn trials_that_do_not_go_together_are_refused() {
        let mut all = trials(&mut ChaCha8Rng::seed_from_u64(2), 29);
        all[4].pop();
        assert_eq!(Golden::learn(&all, 0.5, 0.05), Err(LearnError::OtherInstants(4)));
        let mut all = trials(&mut ChaCha8Rng::seed_from_u64(2), 29);
        all[20][7].frequency_hz = 1e12;
        assert_eq!(Golden::learn(&all, 0.5, 0.05), Err(LearnError::TooDifferent));
    }

    #[test]
    fn a_change_is_seen_in_a_run_of_thirty_trials() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let golden = Golden::learn(&trials(&mut random, 60), 0.5, 0.05).unwrap();
        let same = trials(&mut random, 30);
        let slower: Vec<Vec<Row>> = trials(&mut random, 30)
            .into_iter()
            .map(|rows| rows.into_iter().map(|row| Row { amplitude_um: row.amplitude_um * 0.95, ..row }).collect())
            .collect();
        let compare = |all: &[Vec<Row>]| golden.compare((0..).zip(all.iter().map(Vec::as_slice))).verdict;
        assert_ne!(compare(&same), crate::Verdict::Fail);
        assert_eq!(compare(&slower), crate::Verdict::Fail);
    }
}
