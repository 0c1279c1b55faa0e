//! Searches the worst case of a chain of trials with CMA-ES.
//!
//! N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv 1604.00772. The strategy ranks scores, so that only
//! their order matters. Points beyond the range are moved to its border: worst cases are often there.

use cmaes::{CMAESOptions, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, StandardUniform};
use std::cell::Cell;

/// Standard deviation of the first generation, relative to the range.
const FIRST_STEP: f64 = 0.35;
/// A search that moves less is over; another one starts.
const MIN_STEP: f64 = 1e-3;

/// Minimises the score over [0, 1] in every dimension until `score` returns `None`.
pub(crate) fn search(dimensions: usize, seed: u64, score: &mut dyn FnMut(&[f64]) -> Option<f64>) {
    let is_over = Cell::new(false);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for start in 0_u64.. {
        // The first search starts in the centre of the range, others start anywhere.
        let anywhere: Vec<f64> = (0..dimensions).map(|_| StandardUniform.sample(&mut random)).collect();
        let first = if start == 0 { vec![0.5; dimensions] } else { anywhere };
        let objective = |point: &DVector<f64>| {
            let point: Vec<f64> = point.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            let score = if is_over.get() { None } else { score(&point) };
            is_over.set(score.is_none());
            score.unwrap_or(f64::MAX)
        };
        let options = CMAESOptions::new(first, FIRST_STEP).seed(seed.wrapping_add(start)).tol_x(MIN_STEP);
        let Ok(mut state) = options.build(objective) else { return };
        while !is_over.get() && state.next().is_none() {}
        drop(state);
        if is_over.get() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIMENSIONS: usize = 6;

    /// Trials until the first failure in a box at a corner, whose volume is 10⁻⁴ of the range. The margin is the
    /// largest distance to the box along one axis, as the smallest of several margins is.
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
