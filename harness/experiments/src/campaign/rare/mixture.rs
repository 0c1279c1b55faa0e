//! Estimates a probability by importance sampling from a mixture of normal distributions.
//!
//! The mixture has one component per failing region that is known, and two components that see the
//! others: the distribution of the values itself, which bounds every weight (T. Hesterberg,
//! *Technometrics* 37, 1995, pp. 185-194), and a wide one. Rounds of trials adapt the components of
//! the regions (cross-entropy, as O. Cappé and others, *Statistics and Computing* 18, 2008,
//! pp. 447-459) and add a component at a failing point that the mixture covers badly. Only trials
//! after the last adaptation count, so the estimate has no bias.

use super::trials::{Trials, distance, dot, is_failure, norm, toward};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal, StandardUniform};

/// Share of the distribution of the values itself.
const NOMINAL_SHARE: f64 = 0.05;
const WIDE_SHARE: f64 = 0.15;
/// Share of the wide component in the first round if design points are known.
const FIRST_WIDE_SHARE: f64 = 0.6;
/// Trials of the first round and of a further round, divided by the trials of the chain.
const FIRST_ROUND: u64 = 8;
const ROUND: u64 = 16;
/// Adaptation ends after this share of the chain.
const ADAPTATION: u64 = 2;
/// A region gets a component if one further trial there would be this share of the estimate.
const MAX_TRIAL_SHARE: f64 = 0.05;
const MAX_REGIONS: usize = 12;
const MAX_NEW_REGIONS: usize = 3;
const MIN_REGION_SHARE: f64 = 0.03;
/// From this effective sample size on, the failing points move the centre of their component.
const MIN_SAMPLES_OF_CENTRE: f64 = 8.0;
const BISECTIONS: u32 = 5;
/// Centres nearer than this are one region.
const MIN_DISTANCE: f64 = 0.7;
/// A design point is left out if its β is larger by more than this.
const INDEX_MARGIN: f64 = 2.0;
/// Rule of three: the upper 95 % bound of a count of which none was seen.
const NONE_SEEN: f64 = 3.0;

#[derive(Debug, Clone)]
struct Component {
    centre: Vec<f64>,
    deviation: f64,
    share: f64,
}

impl Component {
    /// Share · density / density of the values.
    fn ratio(&self, point: &[f64]) -> f64 {
        let exponent = (dot(point, point) - (distance(point, &self.centre) / self.deviation).powi(2)) / 2.0;
        self.share * exponent.exp() / self.deviation.powi(i32::try_from(point.len()).unwrap_or(i32::MAX))
    }
}

#[derive(Debug, Clone)]
struct Mixture {
    safety: [Component; 2],
    regions: Vec<Component>,
}

impl Mixture {
    fn new(dimensions: usize, design_points: &[Vec<f64>]) -> Self {
        let component = |deviation| Component { centre: vec![0.0; dimensions], deviation, share: 0.0 };
        let mut mixture = Self { safety: [component(1.0), component(wide_deviation(dimensions))], regions: Vec::new() };
        let smallest = design_points.iter().map(|point| norm(point)).fold(f64::INFINITY, f64::min);
        for point in design_points.iter().filter(|point| norm(point) <= smallest + INDEX_MARGIN) {
            mixture.add(point.clone());
        }
        mixture.share_equally();
        mixture.set_safety_shares(FIRST_WIDE_SHARE);
        mixture
    }

    /// Returns false if the mixture has a component nearby or is full.
    fn add(&mut self, centre: Vec<f64>) -> bool {
        let is_new = self.regions.iter().all(|region| distance(&region.centre, &centre) > MIN_DISTANCE);
        if !is_new || self.regions.len() == MAX_REGIONS {
            return false;
        }
        let share = 1.0 / (self.regions.len() + 1) as f64;
        self.regions.push(Component { centre, deviation: 1.0, share });
        true
    }

    fn share_equally(&mut self) {
        self.regions.iter_mut().for_each(|region| region.share = 1.0);
    }

    /// Gives the rest to the regions, in proportion to their shares.
    fn set_safety_shares(&mut self, wide: f64) {
        let total: f64 = self.regions.iter().map(|region| region.share).sum();
        let scale = if total > 0.0 { 1.0 } else { 1.0 / (NOMINAL_SHARE + wide) };
        let [nominal, other] = &mut self.safety;
        (nominal.share, other.share) = (NOMINAL_SHARE * scale, wide * scale);
        for region in &mut self.regions {
            region.share *= (1.0 - NOMINAL_SHARE - wide) / total;
        }
    }

    fn components(&self) -> impl Iterator<Item = &Component> {
        self.safety.iter().chain(&self.regions)
    }

    /// Density of the mixture / density of the values.
    fn ratio(&self, point: &[f64]) -> f64 {
        self.components().map(|component| component.ratio(point)).sum()
    }

    fn draw(&self, random: &mut ChaCha8Rng) -> Vec<f64> {
        let mut place: f64 = StandardUniform.sample(random);
        let mut chosen = &self.safety[0];
        for component in self.components() {
            chosen = component;
            place -= component.share;
            if place < 0.0 {
                break;
            }
        }
        let coordinate = |centre: &f64| {
            let normal: f64 = StandardNormal.sample(random);
            centre + chosen.deviation * normal
        };
        chosen.centre.iter().map(coordinate).collect()
    }

    /// Moves shares and centres to the failing points, each with its weight.
    fn adapt(&mut self, failing: &[Vec<f64>], weights: &[f64]) {
        let count = self.regions.len();
        let (mut sums, mut squares) = (vec![0.0; count], vec![0.0; count]);
        let mut centres: Vec<Vec<f64>> = self.regions.iter().map(|region| vec![0.0; region.centre.len()]).collect();
        for (point, weight) in failing.iter().zip(weights) {
            let ratios: Vec<f64> = self.regions.iter().map(|region| region.ratio(point)).collect();
            let total: f64 = ratios.iter().sum();
            let parts = sums.iter_mut().zip(&mut squares).zip(&mut centres);
            for (((sum, square), centre), ratio) in parts.zip(ratios).filter(|_| total > 0.0) {
                let part = weight * ratio / total;
                (*sum, *square) = (*sum + part, *square + part * part);
                centre.iter_mut().zip(point).for_each(|(centre, value)| *centre += part * value);
            }
        }
        let total: f64 = sums.iter().sum();
        for (((region, sum), square), centre) in self.regions.iter_mut().zip(sums).zip(squares).zip(centres) {
            region.share = if total > 0.0 { (sum / total).max(MIN_REGION_SHARE) } else { 1.0 };
            if sum * sum >= MIN_SAMPLES_OF_CENTRE * square && sum > 0.0 {
                region.centre = centre.into_iter().map(|value| value / sum).collect();
            }
        }
    }
}

/// Lets a typical point of the wide component lie about five standard deviations from the centre.
fn wide_deviation(dimensions: usize) -> f64 {
    (5.0 / (dimensions as f64).sqrt()).clamp(1.25, 3.0)
}

/// Trials from one mixture, or from several after each other.
#[derive(Default)]
struct Rounds {
    mixtures: Vec<(u64, Mixture)>,
    trials: u64,
    failing: Vec<Vec<f64>>,
}

impl Rounds {
    fn play(&mut self, mixture: &Mixture, count: u64, random: &mut ChaCha8Rng, trials: &mut Trials<'_>) -> Option<()> {
        for _ in 0..count {
            let point = mixture.draw(random);
            if is_failure(&trials.play(&point)?) {
                self.failing.push(point);
            }
        }
        self.trials += count;
        self.mixtures.push((count, mixture.clone()));
        Some(())
    }

    /// Weights of the failing points, as if all rounds were draws from the mean of the mixtures.
    fn weights(&self) -> Vec<f64> {
        let weight = |point: &Vec<f64>| {
            let ratio: f64 = self.mixtures.iter().map(|(count, mixture)| *count as f64 * mixture.ratio(point)).sum();
            self.trials as f64 / ratio
        };
        self.failing.iter().map(weight).collect()
    }
}

pub(super) struct MixtureEstimate {
    pub(super) probability: f64,
    pub(super) coefficient_of_variation: f64,
    pub(super) effective_samples: f64,
    /// Upper bound at 95 % if no trial failed.
    pub(super) ceiling: f64,
    /// Number of components at failing regions.
    pub(super) regions: usize,
}

/// No failing point was found. Trials are left.
pub(super) struct NoFailure;

/// Uses all trials. `None` if they end before the estimate.
pub(super) fn estimate_by_mixture(
    dimensions: usize,
    design_points: &[Vec<f64>],
    total: u64,
    random: &mut ChaCha8Rng,
    trials: &mut Trials<'_>,
) -> Option<Result<MixtureEstimate, NoFailure>> {
    let mut mixture = Mixture::new(dimensions, design_points);
    let mut rounds = Rounds::default();
    rounds.play(&mixture, total / FIRST_ROUND, random, trials)?;
    if trials.failing.is_empty() {
        return Some(Err(NoFailure));
    }
    loop {
        let weights = rounds.weights();
        mixture.adapt(&rounds.failing, &weights);
        let probability = weights.iter().sum::<f64>() / rounds.trials.max(1) as f64;
        let is_covering = !cover(&mut mixture, probability, trials)?;
        mixture.set_safety_shares(WIDE_SHARE);
        let is_adapted = rounds.mixtures.len() > 1 && is_covering;
        if is_adapted || trials.used() + total / ROUND > total / ADAPTATION {
            break;
        }
        rounds.play(&mixture, total / ROUND, random, trials)?;
    }
    let mut last = Rounds::default();
    let count = trials.left();
    last.play(&mixture, count, random, trials)?;
    Some(Ok(last.estimate(&mixture)))
}

/// Adds components at failing points where one trial would dominate the estimate. Returns true if
/// it added one.
fn cover(mixture: &mut Mixture, probability: f64, trials: &mut Trials<'_>) -> Option<bool> {
    let mut has_added = false;
    for _ in 0..MAX_NEW_REGIONS {
        let most = MAX_TRIAL_SHARE * probability * trials.left() as f64;
        mixture.set_safety_shares(WIDE_SHARE);
        let weights = trials.failing.iter().map(|point| mixture.ratio(point).recip());
        let worst = weights.zip(&trials.failing).max_by(|(one, _), (other, _)| one.total_cmp(other));
        let Some((_, point)) = worst.filter(|(weight, _)| *weight > most) else { break };
        let point = point.clone();
        let edge = nearest_failing(&point, trials)?;
        if !mixture.add(edge) {
            break;
        }
        has_added = true;
    }
    Some(has_added)
}

/// The failing point between the centre and `point` that is nearest to the centre.
fn nearest_failing(point: &[f64], trials: &mut Trials<'_>) -> Option<Vec<f64>> {
    let centre = vec![0.0; point.len()];
    let (mut passing, mut failing) = (0.0, 1.0);
    for _ in 0..BISECTIONS {
        let middle = f64::midpoint(passing, failing);
        let is_failing = is_failure(&trials.play(&toward(&centre, point, middle))?);
        *(if is_failing { &mut failing } else { &mut passing }) = middle;
    }
    Some(toward(&centre, point, failing))
}

impl Rounds {
    fn estimate(&self, mixture: &Mixture) -> MixtureEstimate {
        let weights = self.weights();
        let (sum, squares) = (weights.iter().sum::<f64>(), dot(&weights, &weights));
        let count = self.trials as f64;
        let mean = sum / count;
        let variance = (squares / count - mean * mean).max(0.0) / (count - 1.0);
        let largest_weight = mixture.safety[0].share.recip();
        MixtureEstimate {
            probability: mean,
            coefficient_of_variation: if mean > 0.0 { variance.sqrt() / mean } else { f64::INFINITY },
            effective_samples: if mean > 0.0 { sum * sum / squares } else { 0.0 },
            ceiling: (largest_weight * NONE_SEEN / count).min(1.0),
            regions: mixture.regions.len(),
        }
    }
}
