//! Estimates the probability of rare failures from a chain of trials, in standard normal space.
//!
//! A trial at the point u has the score g(u) and fails if g ≤ 0. FORM (first-order reliability
//! method) searches the design point, the failing point with the smallest norm β. If there is
//! exactly one design point, importance sampling around it is used, otherwise subset simulation.

use crate::campaign::distribution::normal_cdf;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::cell::Cell;

pub(crate) mod design_point;
mod estimates;
pub(crate) mod importance;
pub(crate) mod subset;

pub(crate) use estimates::Score;
pub use estimates::{ChainEstimate, CombinedEstimate, RareMethod};

/// Calls `score` `trials` times. `None` if the trials are too few for an estimate.
pub(crate) fn estimate(dimensions: usize, seed: u64, trials: u64, score: &mut Score<'_>) -> Option<ChainEstimate> {
    let used = Cell::new(0);
    let mut counted = |point: &[f64]| {
        if used.get() == trials {
            return None;
        }
        used.set(used.get() + 1);
        score(point)
    };
    let estimate = estimate_from(dimensions, seed, trials, &used, &mut counted);
    // Plays the unused trials too, because a part needs a row for every trial.
    while counted(&vec![0.0; dimensions]).is_some() {}
    estimate
}

fn estimate_from(
    dimensions: usize,
    seed: u64,
    trials: u64,
    used: &Cell<u64>,
    score: &mut Score<'_>,
) -> Option<ChainEstimate> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let found = design_point::find(dimensions, score)?;
    let mut index = None;
    let reason = match found {
        Ok(point) => {
            index = Some(point.reliability_index);
            match importance::estimate(&point.point, &mut random, score)? {
                Ok((probability, coefficient_of_variation)) => {
                    return Some(ChainEstimate {
                        probability,
                        coefficient_of_variation,
                        ceiling: probability,
                        method: RareMethod::ImportanceSampling,
                        reason: format!("one design point at β = {:.3}", point.reliability_index),
                        reliability_index: index,
                        trials,
                    });
                }
                Err(reason) => reason,
            }
        }
        Err(reason) => reason,
    };
    let levels = index.map(|index| -normal_cdf(-index).log10());
    let plan = subset::SubsetPlan { dimensions, trials: trials.saturating_sub(used.get()), levels };
    let found = subset::estimate(&plan, &mut random, score)?;
    Some(ChainEstimate {
        probability: found.probability,
        coefficient_of_variation: found.coefficient_of_variation,
        ceiling: found.ceiling,
        method: RareMethod::SubsetSimulation,
        reason: reason.to_owned(),
        reliability_index: index,
        trials,
    })
}

#[cfg(test)]
mod tests;
