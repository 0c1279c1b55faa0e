use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{ChiSquared, Distribution as _, StandardNormal, Uniform};
use rstest::rstest;

fn part(kind: ComponentKind, distribution: Distribution, standard: f64, freedom: Option<f64>) -> Contribution {
    Contribution {
        kind,
        distribution,
        standard,
        degrees_of_freedom: freedom,
        source: "test".to_owned(),
        date: "2026-03-01".to_owned(),
        instrument: None,
    }
}

fn draw(random: &mut ChaCha8Rng, distribution: Distribution, standard: f64) -> f64 {
    let uniform = |random: &mut ChaCha8Rng| Uniform::new(-1.0_f64, 1.0).unwrap().sample(random);
    let unit = match distribution {
        Distribution::Normal => StandardNormal.sample(random),
        Distribution::Rectangular => uniform(random) * 3.0_f64.sqrt(),
        Distribution::Triangular => f64::midpoint(uniform(random), uniform(random)) * 6.0_f64.sqrt(),
        Distribution::UShaped => (std::f64::consts::PI * uniform(random)).sin() * 2.0_f64.sqrt(),
    };
    unit * standard
}

/// Example H.1 of JCGM 100:2008, an end gauge, in nm. It rounds u to 32 nm and ν to 16.
#[test]
fn the_end_gauge_of_the_guide() {
    let normal = |standard, freedom| part(ComponentKind::Bench, Distribution::Normal, standard, Some(freedom));
    let parts = vec![normal(25.0, 18.0), normal(9.7, 25.6), normal(2.9, 50.0), normal(16.6, 2.0)];
    let whole = CombinedUncertainty::of(parts, 0.99);
    assert!((whole.standard - 31.71).abs() < 0.1, "{whole:?}");
    assert!((whole.degrees_of_freedom.unwrap() - 16.7).abs() < 0.5, "{whole:?}");
    assert!((whole.expanded - 92.0).abs() < 1.0, "{whole:?}");
}

#[test]
fn unlimited_freedom_gives_the_normal_factor() {
    let whole = CombinedUncertainty::of(vec![part(ComponentKind::Bench, Distribution::Normal, 2.0, None)], 0.954_5);
    assert_eq!(whole.degrees_of_freedom, None);
    assert!((whole.coverage_factor - 2.0).abs() < 1e-4 && (whole.expanded - 4.0).abs() < 1e-3);
    assert!((whole.probability_above(0.0, 4.0) - 0.022_75).abs() < 1e-5);
    let none = CombinedUncertainty::of(Vec::new(), 0.95);
    assert_eq!((none.standard, none.expanded, none.probability_above(1.0, 0.9)), (0.0, 0.0, 1.0));
}

/// Components except repeatability: kind, distribution, standard uncertainty, degrees of freedom.
const LABORATORY: [(ComponentKind, Distribution, f64, f64); 7] = [
    (ComponentKind::SensorGain, Distribution::Normal, 0.50, 30.0),
    (ComponentKind::SensorOffset, Distribution::Rectangular, 0.30, f64::INFINITY),
    (ComponentKind::Converter, Distribution::Rectangular, 0.20, f64::INFINITY),
    (ComponentKind::Demodulator, Distribution::UShaped, 0.20, f64::INFINITY),
    (ComponentKind::Temperature, Distribution::Triangular, 0.30, f64::INFINITY),
    (ComponentKind::Timing, Distribution::Rectangular, 0.10, f64::INFINITY),
    (ComponentKind::Bench, Distribution::Normal, 0.05, f64::INFINITY),
];
const TRIALS: usize = 10;
const SCATTER: f64 = 1.0;

/// Returns a measured value and its stated uncertainty. The true value is 0.
pub(crate) fn measure_in_laboratory(random: &mut ChaCha8Rng, coverage: f64) -> (f64, CombinedUncertainty) {
    let trials: Vec<f64> = (0..TRIALS).map(|_| draw(random, Distribution::Normal, SCATTER)).collect();
    let mut value = trials.iter().sum::<f64>() / TRIALS as f64;
    let observed = TypeA::of_mean(&trials).unwrap();
    let freedom = Some(observed.degrees_of_freedom);
    let mut parts = vec![part(ComponentKind::Repeatability, Distribution::Normal, observed.standard, freedom)];
    for (kind, distribution, standard, freedom) in LABORATORY {
        value += draw(random, distribution, standard);
        // The standard deviation of a calibration is itself an estimate with a chi-square
        // distribution.
        let known = if freedom.is_finite() {
            standard * (ChiSquared::new(freedom).unwrap().sample(random) / freedom).sqrt()
        } else {
            standard
        };
        parts.push(part(kind, distribution, known, freedom.is_finite().then_some(freedom)));
    }
    (value, CombinedUncertainty::of(parts, coverage))
}

/// Among 1,000 laboratories, the share of intervals with the true value has a deviation of 0.7 %.
#[test]
fn expanded_intervals_contain_the_true_value() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let contains = |(value, stated): (f64, CombinedUncertainty)| value.abs() <= stated.expanded;
    let blocks: Vec<f64> = (0..50)
        .map(|_| (0..1_000).filter(|_| contains(measure_in_laboratory(&mut random, 0.95))).count() as f64 / 1_000.0)
        .collect();
    let share = blocks.iter().sum::<f64>() / 50.0;
    assert!((0.94..=0.96).contains(&share), "{share}, {blocks:?}");
    assert!(blocks.iter().all(|block| (0.922..=0.978).contains(block)), "{share}, {blocks:?}");
}

/// Propagates the same distributions by the Monte Carlo method of JCGM 101:2008.
#[test]
fn monte_carlo_gives_the_same_uncertainty() {
    let budget = LABORATORY.map(|(kind, distribution, standard, _)| part(kind, distribution, standard, None));
    let stated = CombinedUncertainty::of(budget.to_vec(), 0.95);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut errors: Vec<f64> = (0..200_000)
        .map(|_| {
            LABORATORY.iter().map(|(_, shape, standard, _)| draw(&mut random, *shape, *standard)).sum::<f64>().abs()
        })
        .collect();
    let standard = (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
    assert!((standard / stated.standard - 1.0).abs() < 0.005, "{standard}, {stated:?}");
    errors.sort_by(f64::total_cmp);
    let expanded = errors[errors.len() * 95 / 100];
    assert!((expanded / stated.expanded - 1.0).abs() < 0.02, "{expanded}, {stated:?}");
}

/// Supplement 1 draws a component with ν degrees of freedom from a scaled t distribution.
/// `docs/acceptance.md` states the ratio of the two intervals.
#[rstest]
#[case([30.0, f64::INFINITY], 1.009)]
#[case([9.0, f64::INFINITY], 1.04)]
#[case([5.0, f64::INFINITY], 1.09)]
#[case([9.0, 9.0], 1.07)]
#[case([4.0, 4.0], 1.21)]
fn limited_freedom_widens_the_monte_carlo_interval(#[case] freedoms: [f64; 2], #[case] ratio: f64) {
    let part =
        |freedom: f64| part(ComponentKind::Bench, Distribution::Normal, 1.0, Some(freedom).filter(|f| f.is_finite()));
    let stated = CombinedUncertainty::of(freedoms.map(part).to_vec(), 0.95);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut draw = |freedom: f64| {
        let normal = draw(&mut random, Distribution::Normal, 1.0);
        if freedom.is_infinite() {
            return normal;
        }
        normal / (ChiSquared::new(freedom).unwrap().sample(&mut random) / freedom).sqrt()
    };
    let mut errors: Vec<f64> =
        (0..400_000).map(|_| freedoms.iter().map(|freedom| draw(*freedom)).sum::<f64>().abs()).collect();
    errors.sort_by(f64::total_cmp);
    let found = errors[errors.len() * 95 / 100] / stated.expanded;
    assert!((found / ratio - 1.0).abs() < 0.01, "{found}");
}

#[test]
fn repeatability_comes_from_the_trials() {
    let values = [1.0, 2.0, 3.0, 4.0];
    let [mean, single] = [TypeA::of_mean(&values).unwrap(), TypeA::of_single(&values).unwrap()];
    assert!((mean.standard - (5.0_f64 / 12.0).sqrt()).abs() < 1e-15 && mean.degrees_of_freedom == 3.0);
    assert!((single.standard - 2.0 * mean.standard).abs() < 1e-15);
    let deviation = TypeA::of_stated_deviation(6.0_f64.sqrt(), 4).unwrap();
    assert!((deviation.standard - 1.0).abs() < 1e-15 && TypeA::of_stated_deviation(1.0, 1).is_none());
    assert_eq!(TypeA::of_mean(&[1.0]), None);
}

fn accepted(rule: DecisionRule, distance: f64, laboratories: u32) -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let accepts = |(value, stated): (f64, CombinedUncertainty)| {
        value <= distance
            && decide(rule, value, &stated, (f64::NEG_INFINITY, distance), 10.0, 20.0) == Conformity::Accepted
    };
    let count = (0..laboratories).filter(|_| accepts(measure_in_laboratory(&mut random, 0.95))).count();
    count as f64 / f64::from(laboratories)
}

/// The true value is 0, so with an upper limit of 0 or less every acceptance is false.
#[test]
fn the_guarded_rule_accepts_falsely_below_2_5_percent() {
    let at_limit = accepted(DecisionRule::Guarded, 0.0, 100_000);
    assert!(0.015 < at_limit && at_limit < 0.025, "{at_limit}");
    let beyond = accepted(DecisionRule::Guarded, -0.5, 20_000);
    assert!(beyond < 0.01, "{beyond}");
    let simple = accepted(DecisionRule::Simple, 0.0, 20_000);
    assert!((simple - 0.5).abs() < 0.02, "{simple}");
}

#[test]
fn shared_risk_needs_a_small_uncertainty() {
    let stated = CombinedUncertainty { expanded: 1.0, ..CombinedUncertainty::of(Vec::new(), 0.95) };
    let decided = |tolerance| decide(DecisionRule::SharedRisk, 0.9, &stated, (0.0, 1.0), tolerance, 25.0);
    assert_eq!(decided(4.0), Conformity::Accepted);
    assert_eq!(decided(-2.0), Conformity::TooUncertain { share_percent: 50.0, largest_percent: 25.0 });
    assert!(matches!(decided(0.0), Conformity::TooUncertain { .. }));
}
