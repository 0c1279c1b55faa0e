//! Estimates first-order Sobol indices from trials that were not designed for them.
//!
//! The index of an input X for an output Y is Var(E(Y|X))/Var(Y). The trials are sorted by X into
//! bins of equal size, and E(Y|X) is the mean of Y in a bin. The share of the variance between the
//! bins is corrected for its value if X has no effect: ε² of T. L. Kelley, *Proceedings of the
//! National Academy of Sciences* 21, 1935, pp. 554-559. Total indices need groups of trials that
//! share values, so they are not estimated.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const MIN_TRIALS: usize = 64;
const MAX_BINS: usize = 64;
const RESAMPLES: usize = 400;

#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    count: f64,
    sum: f64,
}

/// Index and bootstrap interval, each end one-sided at `confidence`. `ranks` are the ranks of X
/// from 1, `outputs` the values of Y. `None` if the trials are too few or Y is constant.
pub(crate) fn first_order(ranks: &[f64], outputs: &[f64], confidence: f64, seed: u64) -> Option<(f64, [f64; 2])> {
    let count = ranks.len().min(outputs.len());
    if count < MIN_TRIALS {
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
                let (index, [low, high]) = first_order(&ranks, &outputs, 0.95, seed).unwrap();
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
        assert_eq!(first_order(&ranks, &[2.0; 64], 0.95, 1), None);
        assert_eq!(first_order(&ranks[..63], &ranks[..63], 0.95, 1), None);
        assert!(first_order(&ranks, &ranks, 0.95, 1).unwrap().0 > 0.95);
    }
}
