//! Computes quantiles of values, and rank correlations and first-order indices of margins, over the
//! first trials.

use crate::campaign::definition::{Campaign, Method};
use crate::campaign::first_order::first_order;
use crate::campaign::row::Row;
use platebench_verdict::statistics::quantile::quantile_bounds;
use serde::Serialize;
use serde_json::{Value, json};
use statrs::distribution::{ContinuousCDF, Normal};
use std::fmt::Write as _;

/// Limits the memory. The first trials by number are used, for any order of play.
const MAX_TRIALS: usize = 50_000;
const SHARES: [f64; 3] = [0.05, 0.5, 0.95];
const MIN_TRIALS: usize = 10;

#[derive(Debug, Default)]
pub struct Sample {
    /// One column per variable; NaN for a value that is not a number.
    draws: Vec<Vec<f64>>,
    /// One column per expectation; infinite for a trial without a value.
    values: Vec<Vec<f64>>,
    scores: Vec<f64>,
}

/// Quantile of an expectation's values. With few trials, an end of its interval is infinite.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantile {
    pub expectation: String,
    pub share: f64,
    pub value: f64,
    pub interval: [f64; 2],
}

/// Spearman's rank correlation of a varied value and the smallest margin.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensitivity {
    pub key: String,
    pub correlation: f64,
    pub interval: [f64; 2],
    /// First-order Sobol index of the margin's rank, and its interval; for the methods `sobol` and
    /// `random` only.
    pub first_order: Option<(f64, [f64; 2])>,
}

impl Sample {
    pub(crate) fn add(&mut self, campaign: &Campaign, row: &Row) {
        if self.scores.len() >= MAX_TRIALS {
            return;
        }
        self.draws.resize(campaign.variables.len(), Vec::new());
        self.values.resize(row.values.len(), Vec::new());
        for ((column, variable), draw) in self.draws.iter_mut().zip(&campaign.variables).zip(&row.draws) {
            column.push(variable.distribution.number(*draw).unwrap_or(f64::NAN));
        }
        for (column, value) in self.values.iter_mut().zip(&row.values) {
            column.push(if value.is_nan() { f64::INFINITY } else { *value });
        }
        self.scores.push(row.score);
    }

    pub fn quantiles(&self, campaign: &Campaign) -> Vec<Quantile> {
        let names = campaign.expectation_names();
        let columns = names.iter().zip(&self.values);
        let quantile = |(name, values): (&String, &Vec<f64>), share| {
            let (value, interval) = quantile_bounds(values, share, campaign.confidence)?;
            Some(Quantile { expectation: name.clone(), share, value, interval })
        };
        columns.flat_map(|column| SHARES.map(|share| quantile(column, share))).flatten().collect()
    }

    /// Strongest correlation first. Leaves out variables that are not numbers or never vary.
    pub fn sensitivities(&self, campaign: &Campaign) -> Vec<Sensitivity> {
        let scores = ranks(&self.scores);
        let sensitivity = |(variable, draws): (&crate::campaign::variable::Variable, &Vec<f64>)| {
            let is_number = draws.iter().all(|draw| draw.is_finite()) && draws.len() >= MIN_TRIALS;
            let correlation = correlation(&ranks(draws), &scores).filter(|_| is_number)?;
            let interval = bounds(correlation, draws.len(), campaign.confidence);
            let first_order = matches!(campaign.method, Method::Sobol | Method::Random)
                .then(|| first_order(&ranks(draws), &scores, campaign.confidence, campaign.seed))
                .flatten();
            Some(Sensitivity { key: variable.key.clone(), correlation, interval, first_order })
        };
        let mut found: Vec<_> = campaign.variables.iter().zip(&self.draws).filter_map(sensitivity).collect();
        found.sort_by(|one, other| other.correlation.abs().total_cmp(&one.correlation.abs()));
        found
    }

    pub(crate) fn json(&self, campaign: &Campaign) -> Value {
        let sensitivities = self.sensitivities(campaign).into_iter().map(|sensitivity| {
            json!({ "key": sensitivity.key, "rank_correlation": sensitivity.correlation,
                "interval": sensitivity.interval,
                "first_order": sensitivity.first_order.map(|(index, interval)| {
                    json!({ "index": index, "interval": interval })
                }) })
        });
        json!({ "trials": self.scores.len(), "quantiles": self.quantiles(campaign),
            "sensitivities": sensitivities.collect::<Vec<_>>() })
    }

    pub(crate) fn text(&self, campaign: &Campaign) -> String {
        let mut text = String::new();
        for sensitivity in self.sensitivities(campaign) {
            let [low, high] = sensitivity.interval;
            let _ = writeln!(
                text,
                "rank correlation of {} and the smallest margin: {:.3}, {low:.3} to {high:.3}",
                sensitivity.key, sensitivity.correlation
            );
            if let Some((index, [low, high])) = sensitivity.first_order {
                let _ = writeln!(text, "  first-order index: {index:.3}, {low:.3} to {high:.3}");
            }
        }
        text
    }
}

/// Ranks from 1. Equal values share their mean rank.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    let value = |index: &usize| values.get(*index).copied().unwrap_or(f64::NAN);
    order.sort_by(|one, other| value(one).total_cmp(&value(other)));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for group in order.chunk_by(|one, other| value(one) == value(other)) {
        let rank = first as f64 + f64::midpoint(group.len() as f64, 1.0);
        for index in group {
            if let Some(place) = ranks.get_mut(*index) {
                *place = rank;
            }
        }
        first += group.len();
    }
    ranks
}

/// Pearson's correlation of two lists of ranks. `None` if all ranks of a list are equal.
fn correlation(one: &[f64], other: &[f64]) -> Option<f64> {
    let mean = f64::midpoint(one.len() as f64, 1.0);
    let sum = |one: &[f64], other: &[f64]| -> f64 {
        one.iter().zip(other).map(|(one, other)| (one - mean) * (other - mean)).sum()
    };
    let scale = (sum(one, one) * sum(other, other)).sqrt();
    (scale > 0.0).then(|| sum(one, other) / scale)
}

/// Interval by Fisher's transformation with the variance `(1 + r²/2)/(n − 3)`; D. G. Bonett and T.
/// A. Wright, *Psychometrika* 65, 2000, pp. 23-28.
fn bounds(correlation: f64, count: usize, confidence: f64) -> [f64; 2] {
    let error = ((1.0 + correlation * correlation / 2.0) / (count as f64 - 3.0)).sqrt();
    let reach = Normal::standard().inverse_cdf(confidence) * error;
    let centre = correlation.clamp(-1.0 + 1e-12, 1.0 - 1e-12).atanh();
    [(centre - reach).tanh(), (centre + reach).tanh()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_values_share_their_rank() {
        assert_eq!(ranks(&[3.0, 1.0, 3.0, f64::NEG_INFINITY]), [3.5, 2.0, 3.5, 1.0]);
    }

    #[test]
    fn a_monotone_relation_has_correlation_one() {
        let values: Vec<f64> = (0..50).map(f64::from).collect();
        let cubes: Vec<f64> = values.iter().map(|value| -value.powi(3)).collect();
        assert!((correlation(&ranks(&values), &ranks(&cubes)).unwrap() + 1.0).abs() < 1e-12);
        assert_eq!(correlation(&ranks(&values), &ranks(&[1.0; 50])), None);
    }

    // For a bivariate normal distribution with correlation r, the ranks have ρ = 6/π asin(r/2).
    #[test]
    fn the_interval_contains_the_correlation_as_often_as_stated() {
        use rand_chacha::ChaCha8Rng;
        use rand_chacha::rand_core::SeedableRng;
        use rand_distr::{Distribution as _, StandardNormal};
        let truth = 6.0 / std::f64::consts::PI * (0.6_f64 / 2.0).asin();
        let covered = (0..400).filter(|seed| {
            let mut random = ChaCha8Rng::seed_from_u64(*seed);
            let (mut one, mut other) = (Vec::new(), Vec::new());
            for _ in 0..100 {
                let (x, y): (f64, f64) = (StandardNormal.sample(&mut random), StandardNormal.sample(&mut random));
                one.push(x);
                other.push(0.6 * x + 0.8 * y);
            }
            let found = correlation(&ranks(&one), &ranks(&other)).unwrap();
            let [low, high] = bounds(found, 100, 0.95);
            (low..=high).contains(&truth)
        });
        let covered = covered.count();
        assert!((345..=380).contains(&covered), "{covered} of 400, expected 360 with a standard deviation of 6");
    }
}
