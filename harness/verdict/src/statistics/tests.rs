//! Simulates how often each interval contains the true value.

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
    let power = agreement_power(10, 0.975, ratio).unwrap();
    // Three standard errors of a proportion near a half: 1.9 %.
    assert!((rate - power).abs() < 0.02, "{rate} {power}");
}

#[test]
fn one_value_has_no_bounds() {
    assert_eq!((mean_bounds(&[7.0], 0.95), deviation_bounds(&[7.0], 0.95)), (None, None));
}

#[test]
fn the_power_grows_from_the_level_with_the_distance() {
    let power = |count, ratio| agreement_power(count, 0.975, ratio).unwrap();
    for count in [2, 30, 300] {
        assert!((power(count, 1.0) - 0.05).abs() < 1e-9);
    }
    assert!(power(5, 2.0) < power(10, 2.0) && power(10, 1.5) < power(10, 2.0) && power(10, 0.5) > 0.05);
    assert_eq!(agreement_power(1, 0.975, 2.0), None);
}

#[test]
fn resamples_data_that_are_not_normal() {
    let even: Vec<f64> = (1..=20).map(f64::from).collect();
    assert_eq!(mean_bounds(&even, 0.95).map(|(_, method)| method), Some(EvidenceMethod::T));
    assert_eq!(deviation_bounds(&even, 0.95).map(|(_, method)| method), Some(EvidenceMethod::ChiSquare));
    let skewed: Vec<f64> = even.iter().map(|value| (value / 3.0).exp()).collect();
    let (mean, deviation) = (mean_bounds(&skewed, 0.95).unwrap(), deviation_bounds(&skewed, 0.95).unwrap());
    assert_eq!((mean.1, deviation.1), (EvidenceMethod::Bootstrap, EvidenceMethod::Bootstrap));
    let summary = SampleSummary::of(&skewed).unwrap();
    for ([low, high], value) in [(mean.0, summary.mean), (deviation.0, summary.deviation)] {
        assert!(0.0 < low && low < value && value < high, "{low} {value} {high}");
    }
    let flat: Vec<f64> = [0.0, 1.0].repeat(15);
    let (bounds, method) = deviation_bounds(&flat, 0.95).unwrap();
    let normal = SampleSummary::of(&flat).unwrap().deviation_bounds(0.95).unwrap();
    assert_eq!((method, bounds), (EvidenceMethod::Bootstrap, normal));
    assert_eq!(deviation_bounds(&skewed, 0.999_999_9).unwrap().0, [0.0, f64::INFINITY]);
    assert_eq!(mean_bounds(&skewed, 0.999_999_9).unwrap().0, [f64::NEG_INFINITY, f64::INFINITY]);
}

#[test]
fn the_margin_widens_both_bounds() {
    assert_eq!(widen_bounds([0.5, 0.75], 0.25), [0.25, 1.0]);
    assert_eq!(widen_bounds([0.1, 0.75], 0.25), [0.0, 1.0]);
    assert_eq!(widen_bounds([-0.1, 0.75], 0.0), [-0.1, 0.75]);
}

#[rstest]
// Without events the bound is 1 − 0.05^(1/n): below 1 % it needs 299 trials, below 0.1 % 2995.
#[case(0, 30, 0.0, 0.095_034)]
#[case(0, 299, 0.0, 0.009_969)]
#[case(0, 2_995, 0.0, 0.000_999_7)]
// Each end at 97.5 % gives the two-sided 95 % interval of the tables.
#[case(5, 10, 0.187_086, 0.812_914)]
#[case(10, 10, 0.691_503, 1.0)]
fn the_bounds_are_the_tabulated_ones(#[case] seen: u32, #[case] count: u32, #[case] low: f64, #[case] high: f64) {
    let confidence = if seen == 0 { 0.95 } else { 0.975 };
    let [lower, upper] = clopper_pearson(seen, count, confidence).unwrap();
    assert!((lower - low).abs() < 1e-6 && (upper - high).abs() < 1e-6, "{lower} {upper}");
}

#[test]
fn below_one_percent_needs_299_trials() {
    let upper = |count| clopper_pearson(0, count, 0.95).unwrap()[1];
    assert!(upper(298) > 0.01 && upper(299) < 0.01);
    assert!(upper(2_994) > 0.001 && upper(2_995) < 0.001);
}

#[test]
fn the_tails_are_the_binomial_sums() {
    for (seen, least, most) in [(0, 1.0, 0.125), (1, 0.875, 0.5), (2, 0.5, 0.875), (3, 0.125, 1.0)] {
        assert!(
            (probability_at_least(seen, 3, 0.5) - least).abs() < 1e-12
                && (probability_at_most(seen, 3, 0.5) - most).abs() < 1e-12
        );
    }
    assert_eq!(
        (probability_at_least(4, 3, 0.5), probability_at_most(2, 3, 0.0), probability_at_least(1, 3, 0.0)),
        (0.0, 1.0, 0.0)
    );
}

// Values of mpmath with 40 digits: P(B ≥ k) and P(B ≤ k).
#[rstest]
#[case(100, 50, 0.5, 0.539_794_618_693_589_4, 0.539_794_618_693_589_4)]
#[case(1_000_000, 500_000, 0.500_5, 0.841_586_716_672_080_3, 0.158_897_224_534_987_25)]
#[case(100_000_000, 50_000_000, 0.499_95, 0.158_679_451_003_814_63, 0.841_368_943_140_847_2)]
#[case(100_000_000, 50_000_000, 0.500_1, 0.977_255_267_958_095_3, 0.022_755_530_234_748_452)]
#[case(100_000_000, 1_000_000, 0.010_02, 0.977_736_150_743_805_5, 0.022_317_168_761_164_394)]
#[case(1_000_000_000, 999_999_998, 0.999_999_999, 0.919_698_608_222_746_2, 0.264_241_107_252_774_2)]
#[case(4_000_000_000, 2_000_000_000, 0.500_01, 0.897_051_228_932_742_3, 0.102_954_439_649_868_71)]
#[case(4_000_000_000, 2_000_000_000, 0.499_99, 0.102_954_439_648_610_01, 0.897_051_228_934_001)]
fn the_tails_of_many_trials_are_exact(
    #[case] count: u32,
    #[case] seen: u32,
    #[case] p: f64,
    #[case] least: f64,
    #[case] most: f64,
) {
    let found = [probability_at_least(seen, count, p), probability_at_most(seen, count, p)];
    for (found, expected) in found.into_iter().zip([least, most]) {
        assert!((found / expected - 1.0).abs() < 1e-9, "{found}, expected {expected}");
    }
}

// The normal approximation is exact to some 10⁻⁹ for so many trials.
#[rstest]
#[case(50_000_000)]
#[case(100_000_000)]
#[case(u32::MAX - 1)]
fn the_bounds_of_half_of_many_trials_are_narrow(#[case] count: u32) {
    let [low, high] = clopper_pearson(count / 2, count, 0.95).unwrap();
    let half_width = 1.644_853_627 * 0.5 / f64::from(count).sqrt();
    for (end, expected) in [(low, 0.5 - half_width), (high, 0.5 + half_width)] {
        assert!((end - expected).abs() < 1e-3 * half_width, "{end}, expected {expected}");
    }
}

#[test]
fn no_trials_have_no_bounds() {
    assert_eq!(clopper_pearson(0, 0, 0.95), None);
    assert_eq!(clopper_pearson(2, 1, 0.95), None);
}

fn ramp(count: u32) -> Vec<f64> {
    (1..=count).rev().map(f64::from).collect()
}

#[test]
fn the_ranks_are_the_tabulated_ones() {
    // Ranks 11 and 20 bound the median of 30: P(B ≤ 10) = 0.0494, P(B ≤ 19) = 0.9506.
    assert_eq!(quantile_bounds(&ramp(30), 0.5, 0.95), Some((15.0, [11.0, 20.0])));
    // An upper bound of the 95 % quantile needs 59 values and is then the largest one.
    assert_eq!(quantile_bounds(&ramp(58), 0.95, 0.95).unwrap().1[1], f64::INFINITY);
    assert_eq!(quantile_bounds(&ramp(59), 0.95, 0.95).unwrap().1[1], 59.0);
    assert_eq!((min_values_for_bound(0.95, 0.95), min_values_for_bound(0.05, 0.95)), (59, 59));
    assert_eq!(quantile_bounds(&ramp(92), 0.95, 0.95).unwrap().1[1], 92.0);
    assert_eq!(quantile_bounds(&ramp(93), 0.95, 0.95).unwrap().1[1], 92.0);
}

#[test]
fn low_quantiles_mirror_high_ones() {
    let high = quantile_bounds(&ramp(100), 0.9, 0.95).unwrap().1;
    let low = quantile_bounds(&ramp(100), 0.1, 0.95).unwrap().1;
    assert_eq!(low.map(|rank| 101.0 - rank), [high[1], high[0]]);
    assert_eq!(quantile_bounds(&ramp(10), 0.05, 0.95).unwrap().1[0], f64::NEG_INFINITY);
}

#[test]
fn accepts_infinite_values_and_none() {
    assert_eq!(quantile_bounds(&[], 0.5, 0.95), None);
    let mut values = ramp(93);
    values[0] = f64::INFINITY;
    assert_eq!(quantile_bounds(&values, 0.95, 0.95).unwrap().1[1], 92.0);
    assert_eq!(quantile_bounds(&[1.0], 0.5, 0.95), Some((1.0, [f64::NEG_INFINITY, f64::INFINITY])));
}

#[test]
fn one_look_spends_everything() {
    let planned = plan_looks(30, 30);
    assert_eq!(planned.len(), 1);
    assert_eq!((planned[0].trials, planned[0].confidence(0.95)), (30, 0.95));
}

#[test]
fn the_looks_double_and_end_at_the_last_trial() {
    let sizes = |count, max| plan_looks(count, max).iter().map(|look| look.trials).collect::<Vec<_>>();
    assert_eq!(sizes(30, 200), [30, 60, 120, 200]);
    assert_eq!(sizes(30, 60), [30, 60]);
    assert_eq!(sizes(30, 61), [30, 60, 61]);
    assert_eq!(sizes(1, 3), [1, 2, 3]);
    assert_eq!(sizes(u32::MAX, u32::MAX), [u32::MAX]);
    assert_eq!(sizes(7, 3), [7], "`load` rejects a smaller maximum");
}

#[test]
fn all_looks_together_spend_the_whole_error() {
    for (count, max) in [(30, 200), (2, 1_000), (5, 5), (10, 11)] {
        let planned = plan_looks(count, max);
        let sum: f64 = planned.iter().map(|look| 1.0 - look.confidence(0.9)).sum();
        assert!((sum - 0.1).abs() < 1e-12, "{sum}");
        assert!(planned.iter().all(|look| look.error_share > 0.0));
    }
    // The first look spends ln(1 + 1.71828 · 0.15) = 0.2294 of 5 %.
    assert!((plan_looks(30, 200)[0].confidence(0.95) - 0.988_53).abs() < 1e-5);
}
