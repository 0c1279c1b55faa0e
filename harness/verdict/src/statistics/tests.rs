//! Simulates how often each interval contains the true value.

use super::proportion::clopper_pearson;
use super::quantile::quantile_bounds;
use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Exp1, Gamma, StandardNormal, StandardUniform};
use rstest::rstest;
use std::f64::consts::{FRAC_2_PI, SQRT_2};

#[derive(Debug, Clone, Copy)]
enum TestDistribution {
    Normal,
    HalfNormal,
    Gamma4,
    Exponential,
    Uniform,
    Laplace,
}

impl TestDistribution {
    fn draw(self, random: &mut ChaCha8Rng) -> f64 {
        let normal = |random: &mut ChaCha8Rng| -> f64 { StandardNormal.sample(random) };
        match self {
            Self::Normal => normal(random),
            Self::HalfNormal => normal(random).abs(),
            Self::Gamma4 => Gamma::new(4.0, 1.0).unwrap().sample(random),
            Self::Exponential => Exp1.sample(random),
            Self::Uniform => StandardUniform.sample(random),
            Self::Laplace => {
                let size: f64 = Exp1.sample(random);
                size.copysign(normal(random))
            }
        }
    }

    fn mean(self) -> f64 {
        match self {
            Self::Normal | Self::Laplace => 0.0,
            Self::HalfNormal => FRAC_2_PI.sqrt(),
            Self::Gamma4 => 4.0,
            Self::Exponential => 1.0,
            Self::Uniform => 0.5,
        }
    }

    fn deviation(self) -> f64 {
        match self {
            Self::Normal | Self::Exponential => 1.0,
            Self::HalfNormal => (1.0 - FRAC_2_PI).sqrt(),
            Self::Gamma4 => 2.0,
            Self::Uniform => 12.0_f64.sqrt().recip(),
            Self::Laplace => SQRT_2,
        }
    }
}

/// Percent of runs in which each bound of mean and deviation is on the correct side.
fn coverage(data: TestDistribution, count: usize, confidence: f64, runs: u32) -> [[f64; 2]; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(2016);
    let mut covered = [[0_u32; 2]; 2];
    for _ in 0..runs {
        let values: Vec<f64> = (0..count).map(|_| data.draw(&mut random)).collect();
        let bounds = [mean_bounds(&values, confidence).unwrap().0, deviation_bounds(&values, confidence).unwrap().0];
        for ((covered, [low, high]), truth) in covered.iter_mut().zip(bounds).zip([data.mean(), data.deviation()]) {
            covered[0] += u32::from(low <= truth);
            covered[1] += u32::from(truth <= high);
        }
    }
    covered.map(|ends| ends.map(|end| f64::from(end) * 100.0 / f64::from(runs)))
}

#[rstest]
#[case(12)]
#[case(30)]
#[case(100)]
fn covers_normal_data_at_the_nominal_rate(#[case] count: usize) {
    for end in coverage(TestDistribution::Normal, count, 0.95, 6_000).as_flattened() {
        // 1 % is 3.5 standard errors of 95 % over 6 000 runs.
        assert!((94.0..=96.0).contains(end), "{count}: {end} %");
    }
}

/// Both ends at 97.5 % make a two-sided interval of 95 %.
#[test]
fn covers_normal_data_by_two_sided_intervals() {
    for ends in coverage(TestDistribution::Normal, 30, 0.975, 6_000) {
        let both = ends[0] + ends[1] - 100.0;
        assert!((94.0..=96.0).contains(&both), "{ends:?}");
    }
}

/// Lowest coverage in `docs/verdicts.md`, minus two standard errors of the simulation.
#[rstest]
#[case(TestDistribution::HalfNormal, 30, 92.5, 91.0)]
#[case(TestDistribution::Exponential, 30, 91.5, 84.5)]
#[case(TestDistribution::Exponential, 100, 92.0, 90.0)]
fn covers_skewed_data_as_documented(
    #[case] data: TestDistribution,
    #[case] count: usize,
    #[case] mean: f64,
    #[case] deviation: f64,
) {
    let covered = coverage(data, count, 0.95, 1_000);
    for (ends, least) in covered.into_iter().zip([mean, deviation]) {
        assert!(ends.iter().all(|end| *end >= least), "{data:?} {count}: {covered:?}");
    }
}

/// `cargo test -p platebench-verdict --release -- --ignored coverage_table --nocapture`
#[test]
#[ignore = "takes minutes; for the documentation"]
fn coverage_table() {
    for data in [
        TestDistribution::Normal,
        TestDistribution::Uniform,
        TestDistribution::Laplace,
        TestDistribution::HalfNormal,
        TestDistribution::Gamma4,
        TestDistribution::Exponential,
    ] {
        for count in [12, 30, 100, 300] {
            let [mean, deviation] = coverage(data, count, 0.95, 4_000.min(300_000 / count as u32));
            println!(
                "| {data:?} | {count} | {:.1} / {:.1} | {:.1} / {:.1} |",
                mean[0], mean[1], deviation[0], deviation[1]
            );
        }
    }
}

#[rstest]
#[case(0.01)]
#[case(0.1)]
#[case(0.5)]
fn covers_proportions_at_least_at_the_nominal_rate(#[case] p: f64) {
    let (count, runs) = (50, 10_000);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let bounds: Vec<_> = (0..=count).map(|seen| clopper_pearson(seen, count, 0.95).unwrap()).collect();
    let mut covered = [0_u32; 2];
    for _ in 0..runs {
        let happens = (0..count).filter(|_| Distribution::<f64>::sample(&StandardUniform, &mut random) < p).count();
        covered[0] += u32::from(bounds[happens][0] <= p);
        covered[1] += u32::from(p <= bounds[happens][1]);
    }
    // Counts are discrete: the coverage is at least nominal, with an error of 0.2 %.
    assert!(covered.iter().all(|count| f64::from(*count) / f64::from(runs) >= 0.944), "{covered:?}");
}

#[rstest]
#[case(TestDistribution::Normal, 0.5, 0.0)]
#[case(TestDistribution::Exponential, 0.9, 10.0_f64.ln())]
#[case(TestDistribution::Uniform, 0.95, 0.95)]
fn covers_quantiles_at_least_at_the_nominal_rate(
    #[case] data: TestDistribution,
    #[case] share: f64,
    #[case] truth: f64,
) {
    let runs = 6_000;
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let mut covered = [0_u32; 2];
    for _ in 0..runs {
        let values: Vec<f64> = (0..100).map(|_| data.draw(&mut random)).collect();
        let (_, [low, high]) = quantile_bounds(&values, share, 0.95).unwrap();
        covered[0] += u32::from(low <= truth);
        covered[1] += u32::from(truth <= high);
    }
    let rates = covered.map(|count| f64::from(count) / f64::from(runs));
    // Ranks are whole numbers, so the coverage is at least nominal.
    assert!(rates.iter().all(|rate| (0.942..0.99).contains(rate)), "{rates:?}");
}

#[rstest]
#[case(2.0)]
#[case(1.5)]
#[case(0.5)]
fn the_power_is_the_rate_of_rejected_deviations(#[case] ratio: f64) {
    let runs = 6_000;
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let rejected = (0..runs).filter(|_| {
        let values: Vec<f64> = (0..10).map(|_| ratio * TestDistribution::Normal.draw(&mut random)).collect();
        let [low, high] = SampleSummary::of(&values).unwrap().deviation_bounds(0.975).unwrap();
        !(low..=high).contains(&1.0)
    });
    let rate = rejected.count() as f64 / f64::from(runs);
    let power = bounds::agreement_power(10, 0.975, ratio).unwrap();
    // Three standard errors of a proportion near a half: 1.9 %.
    assert!((rate - power).abs() < 0.02, "{rate} {power}");
}
