//! Estimates the probability of rare failures from a chain of trials, in standard normal space.
//!
//! A trial at the point u has the scores g(u) of its limit states, one per expectation, and fails if
//! one of them is at most 0. `design_point` searches each limit state alone and `mixture` samples
//! around all failing regions that are found. If no failing point is found, `subsets` are used.

mod design_point;
mod mixture;
mod subsets;
mod trials;

use design_point::find_design_points;
use mixture::estimate_by_mixture;
use platebench_verdict::statistics::student_quantile;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use schemars::JsonSchema;
use serde::Serialize;
use subsets::{ScaledTrials, estimate_by_subsets};
use trials::{Trials, norm};

pub(crate) use trials::Play;

/// The search of design points ends after this part of the trials.
const SEARCH_PART: u64 = 4;

/// Calls `play` `trials` times. `None` if the trials are too few for an estimate.
pub(crate) fn estimate(dimensions: usize, seed: u64, trials: u64, play: &mut Play<'_>) -> Option<ChainEstimate> {
    let mut chain = Trials::new(trials, play);
    let estimate = estimate_from(dimensions, seed, trials, &mut chain);
    // Plays the unused trials too, because a part needs a row for every trial.
    while chain.play(&vec![0.0; dimensions]).is_some() {}
    estimate
}

fn estimate_from(dimensions: usize, seed: u64, total: u64, trials: &mut Trials<'_>) -> Option<ChainEstimate> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let scales = trials.play(&vec![0.0; dimensions])?;
    let (points, is_complete) = find_design_points(&scales, total / SEARCH_PART, trials, dimensions)?;
    if let Ok(found) = estimate_by_mixture(dimensions, &points, total, &mut random, trials)? {
        // The centre of a component is the mean of its failing points and lies behind the design point.
        let index = trials.failing.iter().map(|point| norm(point)).min_by(f64::total_cmp);
        let regions = match (found.regions, index) {
            (0, _) | (_, None) => "no region was located".to_owned(),
            (1, Some(index)) => format!("one region at β = {index:.3}"),
            (regions, Some(index)) => format!("{regions} components, the nearest at β = {index:.3}"),
        };
        let left_out = if is_complete { "" } else { "; the design points of some expectations were not searched" };
        return Some(ChainEstimate {
            probability: found.probability,
            coefficient_of_variation: found.coefficient_of_variation,
            effective_samples: found.effective_samples,
            bias: 0.0,
            ceiling: found.ceiling,
            method: RareMethod::ImportanceSampling,
            reason: format!("{regions}{left_out}"),
            reliability_index: index.filter(|_| found.regions == 1),
            trials: total,
        });
    }
    let found = estimate_by_subsets(dimensions, &mut random, &mut ScaledTrials { trials, scales })?;
    Some(ChainEstimate {
        probability: found.probability,
        coefficient_of_variation: found.coefficient_of_variation,
        effective_samples: found.coefficient_of_variation.powi(-2).min(total as f64),
        bias: found.bias,
        ceiling: found.ceiling,
        method: RareMethod::SubsetSimulation,
        reason: "the search found no failing point".to_owned(),
        reliability_index: None,
        trials: total,
    })
}

/// Factor of the standard error. Without it, an end at 95 % holds in 90 to 95 % of the cases, because
/// the largest weights are rare, and small estimates also have small errors.
const ERROR_ALLOWANCE: f64 = 1.4;
/// From this number of chains on, their spread gives the standard error if it is larger than that
/// from the errors of the individual chains.
const MIN_CHAINS_FOR_SPREAD: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RareMethod {
    ImportanceSampling,
    SubsetSimulation,
}

impl RareMethod {
    /// Below this effective sample size, an end of the interval misses the probability in more than
    /// some 10 % of the cases instead of 5 %.
    const fn min_effective_samples(self) -> f64 {
        match self {
            Self::ImportanceSampling => 10.0,
            Self::SubsetSimulation => 4.0,
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct ChainEstimate {
    pub probability: f64,
    /// Standard error divided by `probability`. Infinite if no trial fails.
    pub coefficient_of_variation: f64,
    /// Number of independent failing trials that would be as precise. For importance sampling it is
    /// (Σw)²/Σw² of the weights w of the failing trials, otherwise the inverse square of the
    /// coefficient of variation.
    pub effective_samples: f64,
    /// Bound of the bias, relative to the probability. Importance sampling has none. For subset
    /// simulation it is the sum of `δᵢ δⱼ` over all pairs of levels with the relative standard
    /// errors δ (Au and Beck 2001, proposition 1), because the levels are correlated.
    pub bias: f64,
    /// Upper end of the interval if the coefficient of variation is infinite.
    pub ceiling: f64,
    pub method: RareMethod,
    pub reason: String,
    /// Smallest norm β of a failing trial, if there is only one region. It is the norm of the design
    /// point, or little above it.
    pub reliability_index: Option<f64>,
    pub trials: u64,
}

/// Mean of independent chains, weighted by their trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CombinedEstimate {
    pub probability: f64,
    pub coefficient_of_variation: f64,
    /// Sum of the chains.
    pub effective_samples: f64,
    /// With fewer effective samples, there is no interval.
    pub min_effective_samples: f64,
    bias: f64,
    ceiling: f64,
    /// Number of chains, if their spread is part of the standard error.
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
        let sum_of_squares = |of: &dyn Fn(&ChainEstimate) -> f64| -> f64 {
            estimates.iter().map(|estimate| (estimate.trials as f64 / total.max(1) as f64 * of(estimate)).powi(2)).sum()
        };
        let within = sum_of_squares(&own);
        let between = sum_of_squares(&|estimate| estimate.probability - probability) * count as f64
            / (count as f64 - 1.0).max(1.0);
        // The spread of ten chains is uncertain itself. That within them does not see a region that
        // some chains miss.
        let variance = if has_spread { within.max(between) } else { within };
        let relative = if probability > 0.0 { variance.sqrt() / probability } else { f64::INFINITY };
        Self {
            probability,
            coefficient_of_variation: relative,
            effective_samples: estimates.iter().map(|estimate| estimate.effective_samples).sum(),
            min_effective_samples: estimates
                .iter()
                .map(|estimate| estimate.method.min_effective_samples())
                .fold(f64::INFINITY, f64::min),
            bias: if probability > 0.0 {
                weighted(&|estimate, weight| estimate.probability * estimate.bias * weight) / probability
            } else {
                0.0
            },
            ceiling: weighted(&|estimate, weight| estimate.ceiling * weight),
            spread_over: has_spread.then_some(count),
        }
    }

    /// Log-normal interval; each end is one-sided at `confidence`. The lower end allows for the bias
    /// of subset simulation, which overestimates. `None` if the effective sample size is too small.
    /// Without a failing trial, the upper end is that of the last level, which contains all failing
    /// trials.
    pub fn interval(&self, confidence: f64) -> Option<[f64; 2]> {
        if !self.coefficient_of_variation.is_finite() {
            return Some([0.0, self.ceiling.min(1.0)]);
        }
        if self.effective_samples < self.min_effective_samples {
            return None;
        }
        let freedom = self.spread_over.map_or(f64::INFINITY, |chains| chains as f64 - 1.0);
        let quantile = student_quantile(freedom, confidence);
        // σ of the logarithm, for a log-normal distribution with this coefficient of variation.
        let deviation = ERROR_ALLOWANCE * self.coefficient_of_variation.powi(2).ln_1p().sqrt();
        let factor = (quantile * deviation).exp();
        Some([self.probability / factor / (1.0 + self.bias), (self.probability * factor).min(1.0)])
    }
}

#[cfg(test)]
mod tests;
