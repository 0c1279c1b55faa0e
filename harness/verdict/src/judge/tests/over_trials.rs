use super::*;
use platebench_model::record::{Evidence, EvidenceMethod};
use std::iter;

#[test]
fn trials_without_a_failure_bound_the_failure_rate() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let record = judge_values(&scenario, &[1.9; 30]);
    let [low, high] = record.evidence.failure_rate.unwrap();
    assert_eq!((record.verdict, low, record.confidence), (Verdict::Pass, 0.0, Some(0.95)));
    assert!((high - (1.0 - 0.05_f64.powf(1.0 / 30.0))).abs() < 1e-9);
    let says = "30 trials without a failure: fewer than 9.50 % of all trials fail, with 95.00 % confidence";
    assert_eq!(record.evidence.says.as_deref(), Some(says));
    let mut values = [1.9; 30];
    values[3] = 2.1;
    let [low, high] = judge_values(&scenario, &values).evidence.failure_rate.unwrap();
    assert!((low - 0.001_708).abs() < 1e-5 && (high - 0.148_6).abs() < 1e-3, "{low} {high}");
    let mut open = trials_with_values(&[1.9; 30]);
    open[3].measures = vec![Measure::Interval([1.5, 2.5])];
    let [low, high] = judge_single_expectation(&scenario, &open).evidence.failure_rate.unwrap();
    assert!(low == 0.0 && (high - 0.148_6).abs() < 1e-3, "{low} {high}");
    let certain =
        ScenarioBuilder { expect: &["metric = \"settling_time_ms\", at_most = 2.0"], trials: 2, ..BASE }.scenario();
    assert!(judge_values(&certain, &[1.9, 1.9]).evidence == Evidence::default());
    assert_eq!(judge_values(&certain, &[1.9, 1.9]).confidence, None);
    assert!(judge_values(&certain, &[1.9, 1.8]).evidence.failure_rate.is_some());
}

#[rstest]
#[case("each", Statistic::Worst, PASS)]
#[case("mean", Statistic::Mean, PASS)]
#[case("quantile", Statistic::Quantile, inconclusive(Cause::Evidence))]
fn judges_a_response_time_by_each_statistic(
    #[case] over: &str,
    #[case] statistic: Statistic,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = format!("metric = \"settling_time_ms\", at_most = 2.0, over = \"{over}\"");
    let values = trials_with_values(&values_with_moments(30, 1.9, 0.03));
    assert_eq!(verdict_and_cause(&varied_scenario(&expect, 30), &values), expected);
    let record = judge_single_expectation(&varied_scenario(&expect, 30), &values);
    assert_eq!(record.statistic, statistic);
    let slower = trials_with_values(&values_with_moments(30, 1.9, 0.1));
    let expected = match over {
        "mean" => PASS,
        _ => FAIL,
    };
    assert_eq!(verdict_and_cause(&varied_scenario(&expect, 30), &slower), expected);
}

#[rstest]
#[case::too_few(58, 0, inconclusive(Cause::Evidence))]
#[case::just_enough(59, 0, PASS)]
#[case::one_beyond(59, 1, inconclusive(Cause::Evidence))]
#[case::one_beyond_of_92(92, 1, inconclusive(Cause::Evidence))]
#[case::one_beyond_of_93(93, 1, PASS)]
// At 5 % beyond the limit, P(at least 9 of 93) = 0.045 and P(at least 8) = 0.10.
#[case::eight_beyond(93, 8, inconclusive(Cause::Evidence))]
#[case::nine_beyond(93, 9, FAIL)]
fn a_quantile_is_demonstrated_by_ranks(
    #[case] count: u32,
    #[case] beyond: usize,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = "metric = \"settling_time_ms\", at_most = 2.0, over = \"quantile\"";
    let values: Vec<f64> = (0..count as usize).map(|index| if index < beyond { 3.0 } else { 1.9 }).collect();
    assert_eq!(decide(&varied_scenario(expect, count), &values), expected);
    let mut never = trials_with_values(&values);
    for trial in never.iter_mut().take(beyond) {
        trial.measures = vec![Measure::Missing(MissingValue::NotRunning)];
    }
    assert_eq!(verdict_and_cause(&varied_scenario(expect, count), &never), expected);
    let text = serde_json::to_string(&judge_single_expectation(&varied_scenario(expect, count), &never)).unwrap();
    assert!(serde_json::from_str::<ExpectationRecord>(&text).is_ok(), "{text}");
    let mirrored = "metric = \"settling_time_ms\", at_least = 2.0, over = \"quantile\", quantile = 0.05";
    let values: Vec<f64> = values.iter().map(|value| 4.0 - value).collect();
    let scenario = varied_scenario(mirrored, count);
    assert_eq!(decide(&scenario, &values), expected);
    let mut never = trials_with_values(&values);
    for trial in never.iter_mut().take(beyond) {
        trial.measures = vec![Measure::Missing(MissingValue::NotRunning)];
    }
    assert_eq!(verdict_and_cause(&scenario, &never), expected);
}

#[rstest]
#[case(58, &[], "too few trials to decide: a bound of the 95.00 % quantile needs 59 trials, 58 were run")]
#[case(59, &[3.0], "59 trials show a value between 1.9000 and 3.0000; this does not decide whether it is ≤ 2")]
fn an_undecided_quantile_states_what_is_missing(#[case] count: usize, #[case] beyond: &[f64], #[case] text: &str) {
    let expect = "metric = \"settling_time_ms\", at_most = 2.0, over = \"quantile\"";
    let values: Vec<f64> = beyond.iter().copied().chain(iter::repeat(1.9)).take(count).collect();
    let record = judge_values(&varied_scenario(expect, count as u32), &values);
    assert_eq!(record.reason.unwrap().to_string(), text);
}

#[test]
fn a_deterministic_mean_or_quantile_needs_one_trial() {
    for over in ["mean", "quantile"] {
        let expect = format!("metric = \"settling_time_ms\", at_most = 2.0, over = \"{over}\"");
        let scenario = fixed_scenario(&expect);
        assert_eq!(decide(&scenario, &[2.0]), PASS);
        assert_eq!(decide(&scenario, &[2.0_f64.next_up()]), FAIL);
        assert_eq!(decide(&varied_scenario(&expect, 1), &[1.0]), inconclusive(Cause::Evidence));
        let never = [trial_measures(0, &[Measure::Missing(MissingValue::NotRunning)])];
        assert_eq!(verdict_and_cause(&scenario, &never), FAIL);
    }
}

#[test]
fn adds_the_error_of_the_bench_to_each_trial() {
    let expect = "metric = \"static_error_percent\", at_most = 1.0, over = \"each\"";
    let scenario = fixed_scenario(expect);
    for (error, expected) in [
        (1.0 - 2e-4 - 1e-9, PASS),
        (-1.0 + 2e-4 + 1e-9, PASS),
        (1.0 - 1e-4, inconclusive(Cause::Evidence)),
        (-1.0 - 1e-4, inconclusive(Cause::Evidence)),
        (1.0 + 2e-4 + 1e-9, FAIL),
    ] {
        assert_eq!(decide(&scenario, &[error]), expected, "{error}");
    }
}

#[rstest]
#[case("at_most = 2.0", [1.0, 2.0], PASS)]
#[case("at_most = 2.0", [1.0, 2.0_f64.next_up()], inconclusive(Cause::Evidence))]
#[case("at_most = 2.0", [2.0, 3.0], inconclusive(Cause::Evidence))]
#[case("at_most = 2.0", [2.0_f64.next_up(), 3.0], FAIL)]
#[case("at_least = 2.0", [2.0, 3.0], PASS)]
#[case("at_least = 2.0", [1.0, 3.0], inconclusive(Cause::Evidence))]
#[case("at_least = 2.0", [1.0, 1.5], FAIL)]
#[case("within = [1.0, 3.0]", [1.0, 3.0], PASS)]
#[case("within = [1.5, 3.0]", [1.0, 3.0], inconclusive(Cause::Evidence))]
fn an_interval_that_straddles_the_limit_is_inconclusive(
    #[case] limit: &str,
    #[case] between: [f64; 2],
    #[case] expected: (Verdict, Option<Cause>),
) {
    let scenario = fixed_scenario(&format!("metric = \"settling_time_ms\", {limit}"));
    let sampled = [trial_measures(0, &[Measure::Interval(between)])];
    assert_eq!(verdict_and_cause(&scenario, &sampled), expected);
    assert_eq!(judge_single_expectation(&scenario, &sampled).interval, Some(between));
    let scenario = varied_scenario(&format!("metric = \"settling_time_ms\", {limit}, over = \"mean\""), 30);
    let many: Vec<_> = (0..30).map(|index| trial_measures(index, &[Measure::Interval(between)])).collect();
    assert_eq!(verdict_and_cause(&scenario, &many), expected);
}

#[test]
fn an_agreement_states_its_power() {
    let scenario = varied_scenario("metric = \"repeatability_percent\", about = 1.3", 30);
    let evidence = judge_values(&scenario, &values_with_moments(30, 100.0, 1.3)).evidence;
    assert!(evidence.power.unwrap() > 0.99, "{evidence:?}");
    assert_eq!(evidence.method, Some(EvidenceMethod::ChiSquare));
    assert!(evidence.says.unwrap().starts_with("half or double of 1.3 would be detected in 99."));
    let few = judge_values(
        &varied_scenario("metric = \"repeatability_percent\", about = 1.3", 5),
        &values_with_moments(5, 100.0, 1.3),
    );
    assert!(few.evidence.power.unwrap() < 0.7 && few.verdict == Verdict::Inconclusive);
}
