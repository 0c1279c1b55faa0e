//! Computes rank correlations and first-order indices of an input X for an output Y.
//!
//! The first-order Sobol index is Var(E(Y|X))/Var(Y). The trials are sorted by X into bins of equal
//! size, and E(Y|X) is the mean of Y in a bin. The share of the variance between the bins is
//! corrected for its value if X has no effect: ε² of T. L. Kelley, *Proceedings of the National
//! Academy of Sciences* 21, 1935, pp. 554-559. Total indices need groups of trials that share values,
//! so they are not estimated.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use statrs::distribution::{ContinuousCDF, Normal};

/// Ranks from 1. Equal values share their mean rank.
pub fn ranks(values: &[f64]) -> Vec<f64> {
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
pub fn rank_correlation(one: &[f64], other: &[f64]) -> Option<f64> {
    let mean = f64::midpoint(one.len() as f64, 1.0);
    let sum = |one: &[f64], other: &[f64]| -> f64 {
        one.iter().zip(other).map(|(one, other)| (one - mean) * (other - mean)).sum()
    };
    let scale = (sum(one, one) * sum(other, other)).sqrt();
    (scale > 0.0).then(|| sum(one, other) / scale)
}

/// Interval by Fisher's transformation with the variance `(1 + r²/2)/(n − 3)`; D. G. Bonett and T.
/// A. Wright, *Psychometrika* 65, 2000, pp. 23-28.
pub fn rank_correlation_bounds(correlation: f64, count: usize, confidence: f64) -> [f64; 2] {
    let error = ((1.0 + correlation * correlation / 2.0) / (count as f64 - 3.0)).sqrt();
    let reach = Normal::standard().inverse_cdf(confidence) * error;
    let centre = correlation.clamp(-1.0 + 1e-12, 1.0 - 1e-12).atanh();
    [(centre - reach).tanh(), (centre + reach).tanh()]
}

const MIN_INDEX_TRIALS: usize = 64;
const MAX_BINS: usize = 64;
const RESAMPLES: usize = 400;

#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    count: f64,
    sum: f64,
}

/// Index and bootstrap interval, each end one-sided at `confidence`. `ranks` are the ranks of X
/// from 1, `outputs` the values of Y. `None` if the trials are too few or Y is constant.
pub fn rank_index(ranks: &[f64], outputs: &[f64], confidence: f64, seed: u64) -> Option<(f64, [f64; 2])> {
    let count = ranks.len().min(outputs.len());
    if count < MIN_INDEX_TRIALS {
        return None;
    }
    let bins = count.isqrt().min(MAX_BINS);
    let mean = outputs.iter().sum::<f64>() / outputs.len() as f64;
    let bin = |rank: f64| (((rank - 0.5) * bins as f64 / count as f64) as usize).min(bins - 1);
    let trials: Vec<(usize, f64)> =
        ranks.iter().zip(outputs).map(|(rank, output)| (bin(*rank), output - mean)).collect();
    let share = share_between(bins, trials.iter().copied())?;
    let index = 1.0 - (count - 1) as f64 / (count - bins) as f64 * (1.0 - share);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut deviations = Vec::with_capacity(RESAMPLES);
    for _ in 0..RESAMPLES {
        // The upper 32 bits of this product are uniform below `count`.
        let drawn = (0..count).map(|_| (u64::from(random.next_u32()) * count as u64) >> 32);
        let resample = drawn.filter_map(|place| trials.get(place as usize)).copied();
        let again = share_between(bins, resample)?;
        // The index of the trials without correction is `share`. A resample estimates this index.
        deviations.push(1.0 - (count - 1) as f64 / (count - bins) as f64 * (1.0 - again) - share);
    }
    deviations.sort_by(f64::total_cmp);
    let at = |part: f64| deviations.get((part * (RESAMPLES - 1) as f64).round() as usize).copied();
    // Basic bootstrap: the estimate deviates from the true index as a resample from `share`.
    let [low, high] = [index - at(confidence)?, index - at(1.0 - confidence)?];
    Some((index.clamp(0.0, 1.0), [low.clamp(0.0, 1.0), high.clamp(0.0, 1.0)]))
}

/// Share of the variance of Y between the bins. `None` if Y is constant.
fn share_between(bins: usize, trials: impl Iterator<Item = (usize, f64)>) -> Option<f64> {
    let mut sums = vec![Bin::default(); bins];
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for (bin, output) in trials {
        let bin = sums.get_mut(bin)?;
        bin.count += 1.0;
        bin.sum += output;
        count += 1.0;
        sum += output;
        squares += output * output;
    }
    let offset = sum * sum / count;
    let between: f64 = sums.iter().filter(|bin| bin.count > 0.0).map(|bin| bin.sum * bin.sum / bin.count).sum();
    let total = squares - offset;
    (total > 0.0).then(|| (between - offset) / total)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn equal_values_share_their_rank() {
        assert_eq!(ranks(&[3.0, 1.0, 3.0, f64::NEG_INFINITY]), [3.5, 2.0, 3.5, 1.0]);
    }

    #[test]
    fn a_monotone_relation_has_correlation_one() {
        let values: Vec<f64> = (0..50).map(f64::from).collect();
        let cubes: Vec<f64> = values.iter().map(|value| -value.powi(3)).collect();
        assert!((rank_correlation(&ranks(&values), &ranks(&cubes)).unwrap() + 1.0).abs() < 1e-12);
        assert_eq!(rank_correlation(&ranks(&values), &ranks(&[1.0; 50])), None);
    }

    // For a bivariate normal distribution with correlation r, the ranks have ρ = 6/π asin(r/2).
    #[test]
    fn the_interval_contains_the_correlation_as_often_as_stated() {
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
            let found = rank_correlation(&ranks(&one), &ranks(&other)).unwrap();
            let [low, high] = rank_correlation_bounds(found, 100, 0.95);
            (low..=high).contains(&truth)
        });
        let covered = covered.count();
        assert!((345..=380).contains(&covered), "{covered} of 400, expected 360 with a standard deviation of 6");
    }

    // T. Ishigami and T. Homma, 1990: sin x₁ + 7 sin² x₂ + 0.1 x₃⁴ sin x₁, each x in (−π, π).
    #[test]
    fn the_intervals_contain_the_indices_of_ishigami() {
        let [first, second] = [0.5 * (1.0 + 0.1 * PI.powi(4) / 5.0).powi(2), 49.0 / 8.0];
        let total = 0.5 + 0.1 * PI.powi(4) / 5.0 + 0.01 * PI.powi(8) / 18.0 + 49.0 / 8.0;
        let truths = [first / total, second / total, 0.0];
        let mut covered = [0; 3];
        for seed in 0..100 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let mut inputs = [const { Vec::new() }; 3];
            for input in &mut inputs {
                input.extend((0..2_000).map(|_| PI * (f64::from(random.next_u32()) / 2_f64.powi(31) - 1.0)));
            }
            let [x, y, z] = &inputs;
            let output = |i: usize| x[i].sin() + 7.0 * y[i].sin().powi(2) + 0.1 * z[i].powi(4) * x[i].sin();
            let outputs: Vec<f64> = (0..2_000).map(output).collect();
            for ((input, truth), covered) in inputs.iter().zip(truths).zip(&mut covered) {
                let mut order: Vec<usize> = (0..2_000).collect();
                order.sort_by(|one, other| input[*one].total_cmp(&input[*other]));
                let mut ranks = vec![0.0; 2_000];
                order.iter().enumerate().for_each(|(rank, place)| ranks[*place] = rank as f64 + 1.0);
                let (index, [low, high]) = rank_index(&ranks, &outputs, 0.95, seed).unwrap();
                assert!((index - truth).abs() < 0.08, "{index}, expected {truth}");
                *covered += usize::from((low..=high).contains(&truth));
            }
        }
        // The expected count is 90 of 100, with a standard deviation of 3.
        assert!(covered.iter().all(|covered| *covered >= 80), "{covered:?} of 100");
    }

    #[test]
    fn few_or_equal_outputs_have_no_index() {
        let ranks: Vec<f64> = (1..=64).map(f64::from).collect();
        assert_eq!(rank_index(&ranks, &[2.0; 64], 0.95, 1), None);
        assert_eq!(rank_index(&ranks[..63], &ranks[..63], 0.95, 1), None);
        assert!(rank_index(&ranks, &ranks, 0.95, 1).unwrap().0 > 0.95);
    }
}
