//! Estimates by importance sampling with a standard normal distribution around the design point.

use super::design_point::dot;
use super::estimates::Score;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};

/// If the surface g = 0 is nearly flat at the design point, about half of these trials fail.
const PILOT_TRIALS: u32 = 40;
const MIN_PILOT_FAILURES: u32 = 4;

/// Plays all remaining trials of the chain. Returns the probability of failure and its coefficient
/// of variation, or the reason why the method does not fit. `None` if fewer than [`PILOT_TRIALS`]
/// trials remain.
pub(crate) fn estimate(
    design_point: &[f64],
    random: &mut ChaCha8Rng,
    score: &mut Score<'_>,
) -> Option<Result<(f64, f64), &'static str>> {
    let half_square = dot(design_point, design_point) / 2.0;
    let (mut trials, mut failures, mut sum, mut squares) = (0_u32, 0_u32, 0.0_f64, 0.0_f64);
    loop {
        let point: Vec<f64> = design_point
            .iter()
            .map(|centre| {
                let normal: f64 = StandardNormal.sample(random);
                centre + normal
            })
            .collect();
        let Some(value) = score(&point) else { break };
        trials += 1;
        if value <= 0.0 {
            failures += 1;
            // Likelihood ratio φ(u)/φ(u − u*) of the point u for the design point u*.
            let weight = (half_square - dot(&point, design_point)).exp();
            sum += weight;
            squares += weight * weight;
        }
        if trials == PILOT_TRIALS && failures < MIN_PILOT_FAILURES {
            return Some(Err("few points around the design point fail"));
        }
    }
    if trials < PILOT_TRIALS {
        return None;
    }
    let count = f64::from(trials);
    let mean = sum / count;
    let variance = (squares / count - mean * mean).max(0.0) / (count - 1.0);
    Some(Ok((mean, variance.sqrt() / mean)))
}
