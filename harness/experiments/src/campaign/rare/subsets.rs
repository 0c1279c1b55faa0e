//! Estimates a small probability by subset simulation, a product of conditional probabilities of
//! about 0.1 (S.-K. Au and J. L. Beck, *Probabilistic Engineering Mechanics* 16, 2001, pp. 263-277).
//!
//! The Markov chains use adaptive conditional sampling: I. Papaioannou and others, same journal 41,
//! 2015, pp. 89-103.

use super::trials::{Trials, is_failure};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal, StandardUniform};

const LEVEL_SHARE: f64 = 0.1;
const MIN_LEVEL_TRIALS: usize = 50;
const MAX_LEVELS: i32 = 15;
/// Number of levels that the trials are divided by. It suffices for a probability of 10⁻⁶.
const PLANNED_LEVELS: f64 = 7.0;
const TARGET_ACCEPTANCE: f64 = 0.44;
const SMALLEST_SCORE: f64 = 1e-12;
const MAX_SCORE: f64 = 1e12;

pub(super) struct SubsetEstimate {
    pub(super) probability: f64,
    pub(super) coefficient_of_variation: f64,
    pub(super) bias: f64,
    pub(super) ceiling: f64,
}

/// The trials of the chain, with one score for all limit states.
pub(super) struct ScaledTrials<'a, 'b> {
    pub(super) trials: &'a mut Trials<'b>,
    /// Scores of the centre. Each score is divided by its own, so that no limit state hides another
    /// one only by its unit.
    pub(super) scales: Vec<f64>,
}

impl ScaledTrials<'_, '_> {
    fn play(&mut self, point: &[f64]) -> Option<f64> {
        let scores = self.trials.play(point)?;
        let limits = scores.iter().zip(&self.scales).skip(usize::from(scores.len() > 1));
        let scaled = limits.filter(|(_, scale)| **scale > 0.0).map(|(score, scale)| score / scale);
        let smallest = scaled.fold(MAX_SCORE, f64::min);
        Some(if is_failure(&scores) { smallest.min(-SMALLEST_SCORE) } else { smallest.max(SMALLEST_SCORE) })
    }
}

#[derive(Debug, Clone)]
struct Sample {
    point: Vec<f64>,
    score: f64,
}

/// Markov chains whose scores are at most `threshold`.
struct Level {
    threshold: f64,
    chains: Vec<Vec<Sample>>,
    /// Standard deviation of a step of the Markov chains, 0 to 1.
    deviation: f64,
}

impl Level {
    fn samples(&self) -> usize {
        self.chains.iter().map(Vec::len).sum()
    }

    /// Share of samples with a score up to `limit`, and its relative standard error.
    fn share(&self, limit: f64) -> (f64, f64) {
        let hits = |chain: &Vec<Sample>| chain.iter().filter(|sample| sample.score <= limit).count() as f64;
        let total = self.samples() as f64;
        let share = self.chains.iter().map(hits).sum::<f64>() / total;
        let spread = self.chains.iter().map(|chain| (hits(chain) - share * chain.len() as f64).powi(2)).sum::<f64>();
        (share, spread.sqrt() / total / share)
    }

    /// Adds one sample to each chain until the level has `end` samples.
    fn extend(&mut self, random: &mut ChaCha8Rng, trials: &mut ScaledTrials<'_, '_>, end: usize) -> Option<()> {
        let mut accepted = 0.0_f64;
        let mut tried = 0.0_f64;
        let mut left = end.saturating_sub(self.samples());
        for chain in &mut self.chains {
            if left == 0 {
                break;
            }
            left -= 1;
            let last = chain.last()?.clone();
            let correlation = (1.0 - self.deviation.powi(2)).sqrt();
            let move_by = |value: &f64| {
                let normal: f64 = StandardNormal.sample(random);
                correlation * value + self.deviation * normal
            };
            let point: Vec<f64> = last.point.iter().map(move_by).collect();
            let value = trials.play(&point)?;
            tried += 1.0;
            let is_accepted = value <= self.threshold;
            accepted += f64::from(u8::from(is_accepted));
            chain.push(if is_accepted { Sample { point, score: value } } else { last });
        }
        if tried > 0.0 {
            let step = (accepted / tried - TARGET_ACCEPTANCE).exp();
            self.deviation = (self.deviation * step).clamp(0.05, 1.0);
        }
        Some(())
    }
}

fn draw(dimensions: usize, random: &mut ChaCha8Rng, trials: &mut ScaledTrials<'_, '_>) -> Option<Sample> {
    let point: Vec<f64> = (0..dimensions).map(|_| StandardNormal.sample(random)).collect();
    let score = trials.play(&point)?;
    Some(Sample { point, score })
}

/// Uses all trials. `None` if they are too few for the first level.
pub(super) fn estimate_by_subsets(
    dimensions: usize,
    random: &mut ChaCha8Rng,
    trials: &mut ScaledTrials<'_, '_>,
) -> Option<SubsetEstimate> {
    let budget = usize::try_from(trials.trials.left()).unwrap_or(usize::MAX);
    let planned = budget as f64 / (1.0 + (1.0 - LEVEL_SHARE) * (PLANNED_LEVELS - 1.0));
    let count = ((planned / 10.0) as usize * 10).max(MIN_LEVEL_TRIALS);
    if count > budget {
        return None;
    }
    let first: Option<Vec<_>> = (0..count).map(|_| Some(vec![draw(dimensions, random, trials)?])).collect();
    let mut level = Level { threshold: f64::INFINITY, chains: first?, deviation: 0.8 };
    let (mut probability, mut variance, mut used) = (1.0_f64, 0.0_f64, count);
    let mut sum_of_errors = 0.0_f64;
    for number in 0..MAX_LEVELS {
        let mut scores: Vec<f64> = level.chains.iter().flatten().map(|sample| sample.score).collect();
        scores.sort_by(f64::total_cmp);
        let kept = (scores.len() as f64 * LEVEL_SHARE) as usize;
        let threshold = *scores.get(kept.saturating_sub(1))?;
        let is_last = threshold <= 0.0 || used + (kept * 9) > budget;
        if is_last {
            // The last level uses all remaining trials, which reduces the error of its estimate.
            while used < budget {
                let before = level.samples();
                if number == 0 {
                    level.chains.push(vec![draw(dimensions, random, trials)?]);
                } else {
                    let end = before + (budget - used);
                    level.extend(random, trials, end)?;
                }
                used += level.samples() - before;
            }
            let (share, error) = level.share(0.0);
            let spread = (variance + error * error).sqrt();
            let bias = ((sum_of_errors + error).powi(2) - spread * spread) / 2.0;
            let spread = if share > 0.0 { spread } else { f64::INFINITY };
            let ceiling = probability * (1.0 + 3.0 * variance.sqrt());
            return Some(SubsetEstimate {
                probability: probability * share,
                coefficient_of_variation: spread,
                bias: if share > 0.0 { bias } else { 0.0 },
                ceiling,
            });
        }
        let (share, error) = level.share(threshold);
        probability *= share;
        variance += error * error;
        sum_of_errors += error;
        let mut seeds: Vec<Sample> =
            level.chains.into_iter().flatten().filter(|sample| sample.score <= threshold).collect();
        // Shuffles the seeds, because neighbours in the list come from the same Markov chain.
        for last in (1..seeds.len()).rev() {
            let draw: f64 = StandardUniform.sample(random);
            seeds.swap(last, ((draw * (last + 1) as f64) as usize).min(last));
        }
        seeds.truncate(kept);
        let deviation = level.deviation;
        level = Level { threshold, chains: seeds.into_iter().map(|seed| vec![seed]).collect(), deviation };
        let end = kept * 10;
        while level.samples() < end {
            let before = level.samples();
            level.extend(random, trials, end)?;
            used += level.samples() - before;
        }
    }
    None
}
