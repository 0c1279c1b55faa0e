//! Defines the estimate of a chain, and combines the estimates of several chains.

use serde::Serialize;
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};

/// From this number of chains on, their spread gives the standard error. With fewer chains, the
/// errors of the individual chains give it.
const MIN_CHAINS_FOR_SPREAD: usize = 8;

/// Plays a trial and returns its score. `None` after the last trial or a cancellation.
pub(crate) type Score<'a> = dyn FnMut(&[f64]) -> Option<f64> + 'a;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RareMethod {
    ImportanceSampling,
    SubsetSimulation,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ChainEstimate {
    pub probability: f64,
    /// Standard error divided by `probability`. Infinite if no trial fails.
    pub coefficient_of_variation: f64,
    /// Upper end of the interval if the coefficient of variation is infinite.
    pub ceiling: f64,
    pub method: RareMethod,
    pub reason: String,
    /// Norm β of the design point, if there is only one.
    pub reliability_index: Option<f64>,
    pub trials: u64,
}

/// Mean of independent chains, weighted by their trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CombinedEstimate {
    pub probability: f64,
    pub coefficient_of_variation: f64,
    ceiling: f64,
    /// Number of chains, if their spread gives the standard error.
    spread_over: Option<usize>,
}

impl CombinedEstimate {
    /// `estimates` must not be empty.
    pub fn new(estimates: &[ChainEstimate]) -> Self {
        let total: u64 = estimates.iter().map(|estimate| estimate.trials).sum();
        let weighted = |of: &dyn Fn(&ChainEstimate, f64) -> f64| -> f64 {
            estimates.iter().map(|estimate| of(estimate, estimate.trials as f64 / total.max(1) as f64)).sum()
        };
        let probability = weighted(&|estimate, weight| estimate.probability * weight);
        let own = |estimate: &ChainEstimate| match estimate.probability {
            0.0 => 0.0,
            probability => probability * estimate.coefficient_of_variation,
        };
        let count = estimates.len();
        let has_spread = count >= MIN_CHAINS_FOR_SPREAD;
        let variance: f64 = estimates
            .iter()
            .map(|estimate| {
                let weight = estimate.trials as f64 / total.max(1) as f64;
                let deviation = if has_spread { estimate.probability - probability } else { own(estimate) };
                (weight * deviation).powi(2)
            })
            .sum();
        let variance = if has_spread { variance * count as f64 / (count as f64 - 1.0) } else { variance };
        let relative = if probability > 0.0 { variance.sqrt() / probability } else { f64::INFINITY };
        Self {
            probability,
            coefficient_of_variation: relative,
            ceiling: weighted(&|estimate, weight| estimate.ceiling * weight),
            spread_over: has_spread.then_some(count),
        }
    }

    /// Log-normal interval; each end is one-sided at `confidence`.
    pub fn interval(&self, confidence: f64) -> [f64; 2] {
        if !self.coefficient_of_variation.is_finite() {
            return [0.0, self.ceiling.min(1.0)];
        }
        let student = self.spread_over.and_then(|chains| StudentsT::new(0.0, 1.0, chains as f64 - 1.0).ok());
        let quantile = student
            .map_or_else(|| Normal::standard().inverse_cdf(confidence), |student| student.inverse_cdf(confidence));
        // σ of the logarithm, for a log-normal distribution with this coefficient of variation.
        let deviation = self.coefficient_of_variation.powi(2).ln_1p().sqrt();
        let factor = (quantile * deviation).exp();
        [self.probability / factor, (self.probability * factor).min(1.0)]
    }
}
