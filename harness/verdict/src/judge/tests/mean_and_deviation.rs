use super::*;

/// The quantile of Student's t at 95 % and 29 degrees of freedom, from a table.
const T_29: f64 = 1.699_127;

#[rstest]
#[case::pass(0.9, PASS)]
#[case::just_pass(1.0 - 2e-4 - 1e-4, PASS)]
#[case::just_not(1.0 - 2e-4 + 1e-4, inconclusive(Cause::Evidence))]
#[case::on_the_limit(1.0 + 0.1, inconclusive(Cause::Evidence))]
#[case::just_not_fail(1.2 + 2e-4 - 1e-4, inconclusive(Cause::Evidence))]
#[case::just_fail(1.2 + 2e-4 + 1e-4, FAIL)]
fn compares_both_bounds_of_the_static_error(#[case] mean_plus_half: f64, #[case] expected: (Verdict, Option<Cause>)) {
    let deviation = 0.1 * 30.0_f64.sqrt() / T_29;
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 30);
    for sign in [1.0, -1.0] {
        let values = values_with_moments(30, sign * (mean_plus_half - 0.1), deviation);
        assert_eq!(decide(&scenario, &values), expected);
        let record = judge_values(&scenario, &values);
        assert_eq!((record.statistic, record.confidence), (Statistic::Mean, Some(0.95)));
        assert!((record.value.unwrap() - (mean_plus_half - 0.1).abs()).abs() < 1e-12);
    }
}

#[test]
fn errors_of_opposite_sign_do_not_cancel() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 30);
    let errors: Vec<f64> = (0..30).map(|index| if index % 2 == 0 { 5.0 } else { -5.0 }).collect();
    let record = judge_values(&scenario, &errors);
    assert_eq!((record.verdict, record.value), (Verdict::Fail, Some(5.0)));
}

#[rstest]
#[case("metric = \"static_error_percent\", at_most = 1.0")]
#[case("metric = \"repeatability_percent\", at_most = 1.0")]
fn a_failure_outweighs_an_inconclusive_trial(#[case] expect: &str) {
    let scenario = varied_scenario(expect, 3);
    let measures = [
        Measure::Undefined(UndefinedValue::NotReported),
        Measure::Value(0.0),
        Measure::Missing(MissingValue::NotRunning),
    ];
    let trials: Vec<_> = (0..).zip(measures).map(|(index, measure)| trial_measures(index, &[measure])).collect();
    assert_eq!(verdict_and_cause(&scenario, &trials), FAIL);
    assert_eq!(verdict_and_cause(&varied_scenario(expect, 2), &trials[..2]), inconclusive(Cause::Evidence));
}

#[test]
fn one_random_trial_has_no_mean() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 1);
    let record = judge_values(&scenario, &[0.01]);
    assert_eq!(
        (record.verdict, record.cause, record.value),
        (Verdict::Inconclusive, Some(Cause::Evidence), Some(0.01))
    );
    assert_eq!(
        record.reason.map(|reason| reason.to_string()).as_deref(),
        Some("1 of the trials count, expected at least 2: raise [trials] count or --trials")
    );
}

#[test]
fn one_trial_decides_a_deterministic_scenario() {
    let scenario = fixed_scenario("metric = \"static_error_percent\", at_most = 1.0");
    for (error, expected) in [
        (0.5, PASS),
        (-0.5, PASS),
        (1.0 - 2e-4 - 1e-9, PASS),
        (1.0, inconclusive(Cause::Evidence)),
        (1.001, FAIL),
        (-1.001, FAIL),
    ] {
        assert_eq!(decide(&scenario, &[error]), expected, "{error}");
    }
    let scenario =
        ScenarioBuilder { expect: &["metric = \"static_error_percent\", at_most = 1.0"], trials: 2, ..BASE }.scenario();
    assert_eq!(decide(&scenario, &[0.5, 0.5]), PASS);
    assert_eq!(decide(&scenario, &[0.2, 0.8]), inconclusive(Cause::Evidence));
}

#[rstest]
#[case("at_most = 1.3", 1.015, PASS)]
#[case("at_most = 1.3", 1.017, inconclusive(Cause::Evidence))]
#[case("at_most = 1.3", 1.3, inconclusive(Cause::Evidence))]
// The lower bound is the deviation times √(29/χ²) = 0.8254: 1.58 fails, 1.57 does not.
#[case("at_most = 1.3", 1.57, inconclusive(Cause::Evidence))]
#[case("at_most = 1.3", 1.58, FAIL)]
#[case("at_least = 1.0", 1.22, PASS)]
#[case("at_least = 1.0", 1.20, inconclusive(Cause::Evidence))]
#[case("within = [0.5, 2.0]", 1.3, PASS)]
#[case("within = [1.2, 1.4]", 1.3, inconclusive(Cause::Evidence))]
// The two-sided interval at 95 % is 0.7964 to 1.3443 times the deviation.
#[case("about = 1.3", 0.968, PASS)]
#[case("about = 1.3", 0.966, FAIL)]
#[case("about = 1.3", 1.631, PASS)]
#[case("about = 1.3", 1.634, FAIL)]
fn repeatability_must_be_demonstrated(
    #[case] limit: &str,
    #[case] deviation: f64,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let scenario = varied_scenario(&format!("metric = \"repeatability_percent\", {limit}"), 30);
    let values = trials_with_values(&values_with_moments(30, 100.0, deviation));
    assert_eq!(verdict_and_cause(&scenario, &values), expected);
    let record = judge_single_expectation(&scenario, &values);
    assert!((record.value.unwrap() - deviation).abs() < 1e-9);
    assert_eq!((record.statistic, record.confidence), (Statistic::Deviation, Some(0.95)));
}

#[test]
fn few_trials_cannot_agree() {
    for count in [2, 5, 14] {
        let scenario = varied_scenario("metric = \"repeatability_percent\", about = 1.3", count);
        for deviation in [0.6, 0.9, 1.3, 2.0] {
            let (verdict, _) = decide(&scenario, &values_with_moments(count as usize, 100.0, deviation));
            assert!(verdict != Verdict::Pass || count == 14, "{deviation} over {count} trials");
        }
    }
    let scenario = varied_scenario("metric = \"repeatability_percent\", about = 1.3", 1);
    assert_eq!(decide(&scenario, &[100.0]), inconclusive(Cause::Evidence));
}

#[test]
fn constant_values_are_inconclusive() {
    let scenario = varied_scenario("metric = \"repeatability_percent\", at_most = 1.3", 30);
    assert_eq!(decide(&scenario, &[100.0; 30]), inconclusive(Cause::Evidence));
    let scenario =
        ScenarioBuilder { expect: &["metric = \"repeatability_percent\", at_most = 1.3"], trials: 30, ..BASE }
            .scenario();
    assert_eq!(decide(&scenario, &[100.0; 30]), inconclusive(Cause::Evidence));
}

fn pass_rate(expect: &str, count: usize, draw: impl Fn(f64) -> f64) -> f64 {
    let scenario = varied_scenario(expect, count as u32);
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let runs = 2_000;
    let passed = (0..runs).filter(|_| {
        let values: Vec<f64> = (0..count).map(|_| draw(StandardNormal.sample(&mut random))).collect();
        judge(&scenario, &trials_with_values(&values)).verdict == Verdict::Pass
    });
    passed.count() as f64 / f64::from(runs)
}

#[test]
fn a_controller_at_the_limit_passes_5_percent_of_runs() {
    // Three standard errors of 5 % over 2 000 runs: 1.5 %.
    let mean = pass_rate("metric = \"static_error_percent\", at_most = 1.0", 30, |z| 1.0 + 0.3 * z);
    let below = pass_rate("metric = \"static_error_percent\", at_most = 1.0", 30, |z| -1.0 + 0.3 * z);
    let deviation = pass_rate("metric = \"repeatability_percent\", at_most = 1.3", 30, |z| 100.0 + 1.3 * z);
    for rate in [mean, below, deviation] {
        assert!((rate - 0.05).abs() < 0.015, "{mean} {below} {deviation}");
    }
    let few = pass_rate("metric = \"static_error_percent\", at_most = 1.0", 3, |z| 1.0 + 0.3 * z);
    assert!(few < 0.065, "{few}");
    let agreeing = pass_rate("metric = \"repeatability_percent\", about = 1.3", 30, |z| 100.0 + 1.3 * z);
    assert!((agreeing - 0.95).abs() < 0.015, "{agreeing}");
}
