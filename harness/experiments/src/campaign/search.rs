//! Searches the worst case of a chain of trials with CMA-ES.
//!
//! N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv 1604.00772. Only the order of the
//! scores matters. Points outside the range move to its border, where worst cases often are.

use crate::campaign::evolution::{Candidate, Evolution};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, StandardUniform};

/// Standard deviation of the first generation, relative to the range.
const FIRST_STEP: f64 = 0.35;
/// If the distribution is narrower than this share of the range, a new search starts.
const MIN_STEP: f64 = 1e-3;
/// Best scores of two generations count as equal if they differ by less than this.
const EQUAL_SCORES: f64 = 1e-12;

/// Minimises the score over [0, 1] in every dimension until `score` returns `None`.
pub(crate) fn search(dimensions: usize, seed: u64, score: &mut dyn FnMut(&[f64]) -> Option<f64>) {
    if dimensions == 0 {
        return;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut start = vec![0.5; dimensions];
    while descend(start, &mut random, score).is_some() {
        start = (0..dimensions).map(|_| StandardUniform.sample(&mut random)).collect();
    }
}

/// Searches from one start until scores or points no longer change. `None` if `score` returns it.
fn descend(start: Vec<f64>, random: &mut ChaCha8Rng, score: &mut dyn FnMut(&[f64]) -> Option<f64>) -> Option<()> {
    let dimensions = start.len();
    let mut evolution = Evolution::new(start, FIRST_STEP);
    let generation_size = evolution.generation_size();
    let max_equal_generations = 10 + (30 * dimensions).div_ceil(generation_size);
    let mut equal_generations = 0;
    let mut last_best = f64::NAN;
    loop {
        let mut scored: Vec<(f64, Candidate)> = Vec::with_capacity(generation_size);
        for _ in 0..generation_size {
            let candidate = evolution.draw(random);
            let point: Vec<f64> = candidate.point.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            scored.push((score(&point)?, candidate));
        }
        scored.sort_by(|(one, _), (other, _)| one.total_cmp(other));
        let best = scored.first().map_or(f64::NAN, |(best, _)| *best);
        let is_equal = best == last_best || (best - last_best).abs() < EQUAL_SCORES;
        equal_generations = if is_equal { equal_generations + 1 } else { 0 };
        last_best = best;
        let ranked: Vec<Candidate> = scored.into_iter().map(|(_, candidate)| candidate).collect();
        let is_usable = evolution.update(&ranked);
        if !is_usable || equal_generations >= max_equal_generations || evolution.width() < MIN_STEP {
            return Some(());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIMENSIONS: usize = 6;

    /// Number of trials until the first failure. Trials fail in a box at a corner, with 10⁻⁴ of the
    /// volume of the range. The margin is the largest distance from the box along one axis.
    fn trials_to_corner(seed: u64) -> Option<usize> {
        let side = 1e-4_f64.powf(1.0 / DIMENSIONS as f64);
        let corner = |axis: usize| f64::from(u8::from(seed >> axis & 1 == 1));
        let mut trials = 0;
        let mut found = None;
        search(DIMENSIONS, seed, &mut |point| {
            trials += 1;
            let distance = (0..).zip(point).map(|(axis, value)| (value - corner(axis)).abs());
            let margin = distance.fold(0.0, f64::max) - side;
            if margin < 0.0 && found.is_none() {
                found = Some(trials);
            }
            (found.is_none() && trials < 400).then_some(margin)
        });
        found
    }

    #[test]
    fn finds_a_small_corner_for_every_seed() {
        let mut trials: Vec<_> = (0..50).map(trials_to_corner).collect();
        trials.sort_unstable();
        assert!(trials.iter().all(Option::is_some), "{trials:?}");
        assert!(trials[25] <= Some(60), "median {:?}: {trials:?}", trials[25]);
    }

    #[test]
    fn equal_seeds_give_equal_points() {
        let points = |seed| {
            let mut points = Vec::new();
            search(2, seed, &mut |point| {
                points.push(point.to_vec());
                (points.len() < 300).then(|| point.iter().map(|value| (value - 0.3).powi(2)).sum())
            });
            points
        };
        assert_eq!(points(1), points(1));
        assert_ne!(points(1), points(2));
    }
}
