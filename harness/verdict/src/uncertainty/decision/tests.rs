use super::*;
use crate::uncertainty::combine::CombinedUncertainty;
use crate::uncertainty::combine::tests::measure_in_laboratory;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

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
