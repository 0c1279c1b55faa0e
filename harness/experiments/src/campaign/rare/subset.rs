//! Estimates a probability by subset simulation, as a product of conditional probabilities of
//! about 0.1.
//!
//! S.-K. Au and J. L. Beck, *Probabilistic Engineering Mechanics* 16, 2001, pp. 263-277. The Markov
//! chains use adaptive conditional sampling: I. Papaioannou and others, same journal 41, 2015, pp.
//! 89-103.

use super::estimates::Score;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal, StandardUniform};

const LEVEL_SHARE: f64 = 0.1;
const MIN_LEVEL_TRIALS: usize = 50;
const MAX_LEVELS: i32 = 15;
/// Number of levels if FORM gives no estimate. It suffices for a probability of 10⁻⁶.
const DEFAULT_LEVELS: f64 = 7.0;
const TARGET_ACCEPTANCE: f64 = 0.44;

pub(crate) struct SubsetPlan {
    pub(crate) dimensions: usize,
    pub(crate) trials: u64,
    /// −log10 of the probability that FORM estimates.
    pub(crate) levels: Option<f64>,
}

pub(crate) struct SubsetEstimate {
    pub(crate) probability: f64,
    pub(crate) coefficient_of_variation: f64,
    pub(crate) ceiling: f64,
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
    fn extend(&mut self, random: &mut ChaCha8Rng, score: &mut Score<'_>, end: usize) -> Option<()> {
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
            let value = score(&point)?;
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

fn draw(dimensions: usize, random: &mut ChaCha8Rng, score: &mut Score<'_>) -> Option<Sample> {
    let point: Vec<f64> = (0..dimensions).map(|_| StandardNormal.sample(random)).collect();
    let score = score(&point)?;
    Some(Sample { point, score })
}

/// Uses all trials of the plan. `None` if they are too few for the first level.
pub(crate) fn estimate(plan: &SubsetPlan, random: &mut ChaCha8Rng, score: &mut Score<'_>) -> Option<SubsetEstimate> {
    let budget = usize::try_from(plan.trials).unwrap_or(usize::MAX);
    let levels = plan.levels.map_or(DEFAULT_LEVELS, |digits| digits.max(1.0) + 0.5);
    let planned = budget as f64 / (1.0 + (1.0 - LEVEL_SHARE) * (levels - 1.0));
    let count = ((planned / 10.0) as usize * 10).max(MIN_LEVEL_TRIALS);
    if count > budget {
        return None;
    }
    let first: Option<Vec<_>> = (0..count).map(|_| Some(vec![draw(plan.dimensions, random, score)?])).collect();
    let mut level = Level { threshold: f64::INFINITY, chains: first?, deviation: 0.8 };
    let (mut probability, mut variance, mut used) = (1.0_f64, 0.0_f64, count);
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
                    level.chains.push(vec![draw(plan.dimensions, random, score)?]);
                } else {
                    let end = before + (budget - used);
                    level.extend(random, score, end)?;
                }
                used += level.samples() - before;
            }
            let (share, error) = level.share(0.0);
            let spread = (variance + error * error).sqrt();
            let spread = if share > 0.0 { spread } else { f64::INFINITY };
            let ceiling = probability * (1.0 + 3.0 * variance.sqrt());
            return Some(SubsetEstimate {
                probability: probability * share,
                coefficient_of_variation: spread,
                ceiling,
            });
        }
        let (share, error) = level.share(threshold);
        probability *= share;
        variance += error * error;
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
            level.extend(random, score, end)?;
            used += level.samples() - before;
        }
    }
    None
}
