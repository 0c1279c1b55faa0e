//! Compares estimates with closed forms.

use super::*;

const SEEDS: u64 = 200;

/// Score functions with known failure probabilities (Φ: standard normal distribution function).
#[derive(Debug, Clone, Copy)]
enum Limit {
    /// Score `β − Σ u/√n`, probability Φ(−β).
    Linear(f64),
    /// Score `β − u₁ + c u₂²`, probability from an integral over u₂.
    Curved(f64, f64),
    /// Score `β − |u₁|`, probability 2 Φ(−β).
    TwoSided(f64),
}

impl Limit {
    fn score(self, point: &[f64]) -> f64 {
        match self {
            Self::Linear(index) => index - point.iter().sum::<f64>() / (point.len() as f64).sqrt(),
            Self::Curved(index, curvature) => index - point[0] + curvature * point[1].powi(2),
            Self::TwoSided(index) => index - point[0].abs(),
        }
    }

    fn probability(self) -> f64 {
        match self {
            Self::Linear(index) => normal_cdf(-index),
            Self::Curved(index, curvature) => {
                let step = 1e-3;
                let density = |x: f64| (-x * x / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt();
                let at = |x: f64| normal_cdf(-index - curvature * x * x) * density(x);
                (-8_000..8_000).map(|number| at((f64::from(number) + 0.5) * step) * step).sum()
            }
            Self::TwoSided(index) => 2.0 * normal_cdf(-index),
        }
    }
}

fn run(limit: Limit, dimensions: usize, seed: u64, trials: u64) -> ChainEstimate {
    estimate(dimensions, seed, trials, &mut |point| Some(limit.score(point))).unwrap()
}

/// Returns the method, the share of intervals that contain the probability, and mean and standard
/// deviation of the estimates relative to the probability.
fn repeat(limit: Limit, dimensions: usize, trials: u64) -> (RareMethod, f64, f64, f64) {
    let exact = limit.probability();
    let estimates: Vec<_> = (0..SEEDS).map(|seed| run(limit, dimensions, seed, trials)).collect();
    let covered = estimates.iter().filter(|estimate| {
        let [low, high] = CombinedEstimate::new(std::slice::from_ref(estimate)).interval(0.95);
        (low..=high).contains(&exact)
    });
    let covered = covered.count() as f64 / SEEDS as f64;
    let mean = estimates.iter().map(|estimate| estimate.probability).sum::<f64>() / SEEDS as f64;
    let variance = estimates.iter().map(|estimate| (estimate.probability / exact - 1.0).powi(2)).sum::<f64>();
    (estimates[0].method, covered, mean / exact, (variance / SEEDS as f64).sqrt())
}

#[test]
fn importance_sampling_agrees_with_closed_forms() {
    let cases = [
        (Limit::Linear(4.753_424), 2),
        (Limit::Linear(4.753_424), 5),
        (Limit::Linear(3.0), 6),
        (Limit::Curved(4.0, 0.1), 3),
        (Limit::Curved(3.5, -0.05), 4),
    ];
    for (limit, dimensions) in cases {
        let (method, covered, mean, deviation) = repeat(limit, dimensions, 800);
        assert_eq!(method, RareMethod::ImportanceSampling, "{limit:?}");
        // Both ends at 95 % give 90 %, with a standard deviation of 2 % over 200 seeds.
        assert!(covered >= 0.85, "{limit:?}: {covered}");
        assert!((mean - 1.0).abs() < 0.03 && deviation < 0.15, "{limit:?}: {mean} {deviation}");
    }
}

#[test]
fn several_failing_regions_need_subset_simulation() {
    for (limit, dimensions) in [(Limit::TwoSided(4.0), 2), (Limit::TwoSided(3.0), 6)] {
        let (method, covered, mean, deviation) = repeat(limit, dimensions, 4_000);
        assert_eq!(method, RareMethod::SubsetSimulation, "{limit:?}");
        assert!(covered >= 0.85, "{limit:?}: {covered}");
        assert!((mean - 1.0).abs() < 0.15, "{limit:?}: {mean} {deviation}");
    }
}

/// Median (50 seeds) of the smallest number of trials with a coefficient of variation ≤ 0.1.
fn trials_for_precision(limit: Limit, dimensions: usize) -> u64 {
    let trials = |seed| {
        let (mut low, mut high) = (100, 4_000);
        while low < high {
            let middle = u64::midpoint(low, high);
            let estimate = estimate(dimensions, seed, middle, &mut |point| Some(limit.score(point)));
            let is_precise = estimate.is_some_and(|estimate| estimate.coefficient_of_variation <= 0.1);
            if is_precise { high = middle } else { low = middle + 1 }
        }
        low
    };
    let mut trials: Vec<_> = (0..50).map(trials).collect();
    trials.sort_unstable();
    trials[25]
}

// The last column is the median that OpenTURNS needs (harness/experiments/openturns.py).
#[test]
fn needs_few_trials_for_a_coefficient_of_variation_of_10_percent() {
    let cases = [
        (Limit::Linear(4.753_424), 2, 563, 546.0),
        (Limit::Linear(4.753_424), 5, 583, 556.0),
        (Limit::Linear(3.0), 6, 395, 350.0),
        (Limit::Curved(4.0, 0.1), 3, 573, 540.0),
        (Limit::Curved(3.5, -0.05), 4, 477, 427.5),
    ];
    for (limit, dimensions, expected, openturns) in cases {
        let trials = trials_for_precision(limit, dimensions);
        assert!(trials.abs_diff(expected) <= 5, "{limit:?} in {dimensions} dimensions: {trials}");
        assert!(trials as f64 <= 1.5 * openturns, "{limit:?}: {trials}");
    }
}
