//! Searches the worst case of a chain of trials with CMA-ES and negative weights.
//!
//! N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv 1604.00772, appendix A. The comments
//! contain the symbols of this tutorial. Only the order of the scores matters. Points outside the
//! range move to its border, where worst cases often are.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, StandardNormal, StandardUniform};

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

/// Largest ratio of two eigenvalues of C. Above it, rounding errors determine the directions.
const MAX_CONDITION: f64 = 1e14;

/// The normal distribution N(mean, step² C). The covariance is C = B D² Bᵀ.
pub(crate) struct Evolution {
    rates: Rates,
    generation: i32,
    mean: DVector<f64>,
    /// σ, the step size.
    step: f64,
    covariance: DMatrix<f64>,
    /// B D: makes a sample of N(0, C) from one of N(0, I).
    scaled_axes: DMatrix<f64>,
    /// C^(−½)
    inverse_root: DMatrix<f64>,
    /// `p_σ`, the evolution path of the step size.
    step_path: DVector<f64>,
    /// `p_c`, the evolution path of C.
    covariance_path: DVector<f64>,
}

/// A point of the generation: mean + step · `direction`, with `direction` from N(0, C).
pub(crate) struct Candidate {
    pub(crate) point: Vec<f64>,
    direction: DVector<f64>,
}

impl Evolution {
    pub(crate) fn new(mean: Vec<f64>, step: f64) -> Self {
        let dimensions = mean.len();
        Self {
            rates: Rates::new(dimensions),
            generation: 0,
            mean: DVector::from_vec(mean),
            step,
            covariance: DMatrix::identity(dimensions, dimensions),
            scaled_axes: DMatrix::identity(dimensions, dimensions),
            inverse_root: DMatrix::identity(dimensions, dimensions),
            step_path: DVector::zeros(dimensions),
            covariance_path: DVector::zeros(dimensions),
        }
    }

    /// Candidates per generation, λ.
    pub(crate) fn generation_size(&self) -> usize {
        self.rates.weights.len()
    }

    pub(crate) fn draw(&self, random: &mut ChaCha8Rng) -> Candidate {
        let independent = DVector::from_fn(self.mean.len(), |_, _| StandardNormal.sample(random));
        let direction = &self.scaled_axes * independent;
        let point = &self.mean + self.step * &direction;
        Candidate { point: point.iter().copied().collect(), direction }
    }

    /// Adapts the distribution to a whole generation, best candidate first. Returns false if C is
    /// no longer positive definite in double precision. The caller must then start a new search.
    pub(crate) fn update(&mut self, ranked: &[Candidate]) -> bool {
        let Rates { weights, selected_mass, .. } = &self.rates;
        let (for_path, for_one, for_many) = (self.rates.path, self.rates.rank_one, self.rates.rank_many);
        let (for_step, damping) = (self.rates.step, self.rates.step_damping);
        let n = self.mean.len() as f64;

        let mut shift = DVector::zeros(self.mean.len());
        for (candidate, weight) in ranked.iter().zip(weights).filter(|(_, weight)| **weight > 0.0) {
            shift.axpy(*weight, &candidate.direction, 1.0);
        }
        self.mean.axpy(self.step, &shift, 1.0);

        let step_gain = (for_step * (2.0 - for_step) * selected_mass).sqrt();
        self.step_path = (1.0 - for_step) * &self.step_path + step_gain * (&self.inverse_root * &shift);
        // Mean length of a sample of N(0, I).
        let mean_length = n.sqrt() * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n));
        let path_length = self.step_path.norm();
        self.step *= (for_step / damping * (path_length / mean_length - 1.0)).exp();

        // A long path means that the step is too small. Then `p_c` is not extended (`h_σ` is 0).
        self.generation += 1;
        let settled = (1.0 - (1.0 - for_step).powi(2 * self.generation)).sqrt();
        let is_short = path_length / settled < (1.4 + 2.0 / (n + 1.0)) * mean_length;
        let path_gain = if is_short { (for_path * (2.0 - for_path) * selected_mass).sqrt() } else { 0.0 };
        self.covariance_path = (1.0 - for_path) * &self.covariance_path + path_gain * shift;

        let lost = if is_short { 0.0 } else { for_path * (2.0 - for_path) };
        self.covariance *= 1.0 + for_one * lost - for_one - for_many * weights.iter().sum::<f64>();
        self.covariance.ger(for_one, &self.covariance_path, &self.covariance_path, 1.0);
        for (candidate, weight) in ranked.iter().zip(weights) {
            let direction = &candidate.direction;
            // A negative weight is multiplied by n/|C^(−½) direction|², so that C stays positive
            // definite.
            let scale = if *weight < 0.0 { n / (&self.inverse_root * direction).norm_squared() } else { 1.0 };
            self.covariance.ger(for_many * weight * scale, direction, direction, 1.0);
        }
        self.decompose()
    }

    /// Standard deviation of the widest coordinate.
    pub(crate) fn width(&self) -> f64 {
        self.step * self.covariance.diagonal().max().sqrt()
    }

    fn decompose(&mut self) -> bool {
        let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::new(self.covariance.clone());
        let lengths = eigenvalues.map(f64::sqrt);
        self.scaled_axes = &eigenvectors * DMatrix::from_diagonal(&lengths);
        let inverses = DMatrix::from_diagonal(&lengths.map(f64::recip));
        self.inverse_root = &eigenvectors * inverses * eigenvectors.transpose();
        eigenvalues.min() > 0.0 && eigenvalues.max() / eigenvalues.min() < MAX_CONDITION && self.step.is_finite()
    }
}

/// Default weights and learning rates of the tutorial, table 1.
struct Rates {
    /// Weights w of the ranks, best rank first. The weights of the worse half are negative.
    weights: Vec<f64>,
    /// Variance-effective number of selected candidates, `μ_eff`.
    selected_mass: f64,
    /// `c_σ`, learning rate of the path `p_σ`.
    step: f64,
    /// `d_σ`, damping of the step size.
    step_damping: f64,
    /// `c_c`, learning rate of the path `p_c`.
    path: f64,
    /// `c_1`, learning rate of the rank-one update of C.
    rank_one: f64,
    /// `c_μ`, learning rate of the rank-μ update of C.
    rank_many: f64,
}

impl Rates {
    fn new(dimensions: usize) -> Self {
        let n = dimensions as f64;
        let size = 4 + (3.0 * n.ln()).floor() as usize;
        let raw = |rank: usize| f64::midpoint(size as f64, 1.0).ln() - (rank as f64).ln();
        let mut weights: Vec<f64> = (1..=size).map(raw).collect();
        let (selected, others) = weights.split_at_mut(size / 2);
        let selected_mass = effective_mass(selected);

        let rank_one = 2.0 / ((n + 1.3).powi(2) + selected_mass);
        let rank_many = (2.0 * (0.25 + selected_mass + 1.0 / selected_mass - 2.0)
            / ((n + 2.0).powi(2) + selected_mass))
            .min(1.0 - rank_one);
        let step = (selected_mass + 2.0) / (n + selected_mass + 5.0);
        let excess = ((selected_mass - 1.0) / (n + 1.0)).sqrt() - 1.0;

        let negative_sum = (1.0 + rank_one / rank_many)
            .min(1.0 + 2.0 * effective_mass(others) / (selected_mass + 2.0))
            .min((1.0 - rank_one - rank_many) / (n * rank_many));
        scale_to_sum(selected, 1.0);
        scale_to_sum(others, -negative_sum);
        Self {
            weights,
            selected_mass,
            step,
            step_damping: 1.0 + 2.0 * excess.max(0.0) + step,
            path: (4.0 + selected_mass / n) / (n + 4.0 + 2.0 * selected_mass / n),
            rank_one,
            rank_many,
        }
    }
}

fn effective_mass(weights: &[f64]) -> f64 {
    weights.iter().sum::<f64>().powi(2) / weights.iter().map(|weight| weight * weight).sum::<f64>()
}

fn scale_to_sum(weights: &mut [f64], sum: f64) {
    let factor = sum / weights.iter().sum::<f64>();
    for weight in weights {
        *weight *= factor;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;
    use rstest::rstest;

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

    fn scores_until(target: f64, dimensions: usize, seed: u64, score: impl Fn(&[f64]) -> f64) -> usize {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut evolution = Evolution::new(vec![0.5; dimensions], 0.3);
        for generation in 1..2000 {
            let mut ranked: Vec<_> = (0..evolution.generation_size()).map(|_| evolution.draw(&mut random)).collect();
            ranked.sort_by(|one, other| score(&one.point).total_cmp(&score(&other.point)));
            if score(&ranked[0].point) < target {
                return generation * ranked.len();
            }
            assert!(evolution.update(&ranked), "generation {generation}");
        }
        panic!("not found");
    }

    fn sphere(point: &[f64]) -> f64 {
        point.iter().map(|x| x * x).sum()
    }

    /// Quadratic function with coefficients from 1 to 10⁶, so the covariance must adapt.
    fn ellipsoid(point: &[f64]) -> f64 {
        let last = point.len() as f64 - 1.0;
        (0..).zip(point).map(|(axis, x)| 1e6_f64.powf(f64::from(axis) / last) * x * x).sum()
    }

    fn rosenbrock(point: &[f64]) -> f64 {
        point.windows(2).map(|x| 100.0 * (x[1] - x[0] * x[0]).powi(2) + (1.0 - x[0]).powi(2)).sum()
    }

    /// Bounds are 1.5 times the medians of the crate `cmaes` 0.2.2: 864, 1 899 and 2 061 calls.
    #[rstest]
    #[case::sphere(sphere, 1300)]
    #[case::ellipsoid(ellipsoid, 2850)]
    #[case::rosenbrock(rosenbrock, 3100)]
    fn finds_the_minimum(#[case] score: fn(&[f64]) -> f64, #[case] bound: usize) {
        let mut scores: Vec<_> = (0..21).map(|seed| scores_until(1e-9, 6, seed, score)).collect();
        scores.sort_unstable();
        assert!(scores[10] <= bound, "median {} of {scores:?}", scores[10]);
    }

    #[test]
    fn weights_match_the_tutorial() {
        let rates = Rates::new(6);
        assert_eq!(rates.weights.len(), 9);
        assert!((rates.weights.iter().filter(|weight| **weight > 0.0).sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(rates.weights.is_sorted_by(|one, other| one > other));
    }

    #[test]
    fn one_dimension_works() {
        assert!(scores_until(1e-12, 1, 1, sphere) < 400);
    }
}
