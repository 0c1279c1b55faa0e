//! Computes quantiles of values, and rank correlations and first-order indices of margins, over the
//! first trials.

use crate::campaign::definition::{Campaign, Method};
use crate::campaign::distribution::Variable;
use crate::campaign::row::TrialRow;
use platebench_verdict::statistics::{quantile_bounds, rank_correlation, rank_correlation_bounds, rank_index, ranks};
use schemars::JsonSchema;
use serde::Serialize;

/// Limits the memory. The first trials by number are used, for any order of play.
const MAX_TRIALS: usize = 50_000;
const SHARES: [f64; 3] = [0.05, 0.5, 0.95];
const MIN_TRIALS: usize = 10;

#[derive(Debug, Default)]
pub struct TrialSample {
    /// One column per variable; NaN for a value that is not a number.
    draws: Vec<Vec<f64>>,
    /// One column per expectation; infinite for a trial without a value.
    values: Vec<Vec<f64>>,
    scores: Vec<f64>,
}

/// Quantile of an expectation's values. With few trials, an end of its interval is infinite.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Quantile {
    pub expectation: String,
    pub share: f64,
    /// `null` if infinite, as are the ends of the interval.
    #[schemars(with = "Option<f64>")]
    pub value: f64,
    #[schemars(with = "[Option<f64>; 2]")]
    pub interval: [f64; 2],
}

/// Spearman's rank correlation of a varied value and the smallest margin.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct RankSensitivity {
    pub key: String,
    #[serde(rename = "rank_correlation")]
    pub correlation: f64,
    pub interval: [f64; 2],
    /// For the methods `sobol` and `random` only.
    pub first_order: Option<FirstOrderIndex>,
}

/// First-order Sobol index of the margin's rank.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct FirstOrderIndex {
    pub index: f64,
    pub interval: [f64; 2],
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct SampleResult {
    pub trials: usize,
    pub quantiles: Vec<Quantile>,
    pub sensitivities: Vec<RankSensitivity>,
}

impl TrialSample {
    pub(crate) fn add(&mut self, campaign: &Campaign, row: &TrialRow) {
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

    pub(crate) fn result(&self, campaign: &Campaign) -> SampleResult {
        SampleResult {
            trials: self.scores.len(),
            quantiles: self.quantiles(campaign),
            sensitivities: self.sensitivities(campaign),
        }
    }

    fn quantiles(&self, campaign: &Campaign) -> Vec<Quantile> {
        let names = campaign.expectation_names();
        let columns = names.iter().zip(&self.values);
        let quantile = |(name, values): (&String, &Vec<f64>), share| {
            let (value, interval) = quantile_bounds(values, share, campaign.confidence)?;
            Some(Quantile { expectation: name.clone(), share, value, interval })
        };
        columns.flat_map(|column| SHARES.map(|share| quantile(column, share))).flatten().collect()
    }

    /// Strongest correlation first. Leaves out variables that are not numbers or never vary.
    fn sensitivities(&self, campaign: &Campaign) -> Vec<RankSensitivity> {
        let scores = ranks(&self.scores);
        let sensitivity = |(variable, draws): (&Variable, &Vec<f64>)| {
            let is_number = draws.iter().all(|draw| draw.is_finite()) && draws.len() >= MIN_TRIALS;
            let draws = ranks(draws);
            let correlation = rank_correlation(&draws, &scores).filter(|_| is_number)?;
            let interval = rank_correlation_bounds(correlation, draws.len(), campaign.confidence);
            let first_order = matches!(campaign.method, Method::Sobol | Method::Random)
                .then(|| rank_index(&draws, &scores, campaign.confidence, campaign.seed))
                .flatten()
                .map(|(index, interval)| FirstOrderIndex { index, interval });
            Some(RankSensitivity { key: variable.key.clone(), correlation, interval, first_order })
        };
        let mut found: Vec<_> = campaign.variables.iter().zip(&self.draws).filter_map(sensitivity).collect();
        found.sort_by(|one, other| other.correlation.abs().total_cmp(&one.correlation.abs()));
        found
    }
}
