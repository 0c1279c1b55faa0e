//! What trials come to, and what that shows.

use super::*;

#[test]
fn trials_without_a_failure_bound_the_failure_rate() {
    let scenario = spread("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let record = judged(&scenario, &trials(&[1.9; 30]));
    let [low, high] = record.evidence.failure_rate.unwrap();
    assert_eq!((record.verdict, low, record.confidence), (Verdict::Pass, 0.0, Some(0.95)));
    assert!((high - (1.0 - 0.05_f64.powf(1.0 / 30.0))).abs() < 1e-9);
    let says = "30 trials without a failure: fewer than 9.50 % of all fail, at 95.00 %";
    assert_eq!(record.evidence.says.as_deref(), Some(says));
    let mut values = [1.9; 30];
    values[3] = 2.1;
    let [low, high] = judged(&scenario, &trials(&values)).evidence.failure_rate.unwrap();
    assert!((low - 0.001_708).abs() < 1e-5 && (high - 0.148_6).abs() < 1e-3, "{low} {high}");
    // What samples leave open may be a failure or not.
    let mut open = trials(&[1.9; 30]);
    open[3].measures = vec![Measure::Between([1.5, 2.5])];
    let [low, high] = judged(&scenario, &open).evidence.failure_rate.unwrap();
    assert!(low == 0.0 && (high - 0.148_6).abs() < 1e-3, "{low} {high}");
    // What could not have come out otherwise shows no rate, and trials that differ all the same do.
    let certain = Build { expect: &["metric = \"settling_time_ms\", at_most = 2.0"], trials: 2, ..ONE }.scenario();
    assert!(judged(&certain, &trials(&[1.9, 1.9])).evidence.is_empty());
    assert_eq!(judged(&certain, &trials(&[1.9, 1.9])).confidence, None);
    assert!(judged(&certain, &trials(&[1.9, 1.8])).evidence.failure_rate.is_some());
}

#[rstest]
#[case("each", "worst", PASS)]
#[case("mean", "mean", PASS)]
#[case("quantile", "quantile", doubt(Cause::Evidence))]
fn a_response_time_can_be_judged_each_way(
    #[case] over: &str,
    #[case] statistic: &str,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = format!("metric = \"settling_time_ms\", at_most = 2.0, over = \"{over}\"");
    let values = trials(&with_moments(30, 1.9, 0.03));
    assert_eq!(verdict(&spread(&expect, 30), &values), expected);
    let record = judged(&spread(&expect, 30), &values);
    assert_eq!(record.statistic, statistic);
    // Slower trials: the mean is still good where the worst is not.
    let slower = trials(&with_moments(30, 1.9, 0.1));
    let expected = match over {
        "mean" => PASS,
        _ => FAIL,
    };
    assert_eq!(verdict(&spread(&expect, 30), &slower), expected);
}

#[rstest]
#[case::too_few(58, 0, doubt(Cause::Evidence))]
#[case::just_enough(59, 0, PASS)]
#[case::one_beyond(59, 1, doubt(Cause::Evidence))]
#[case::one_beyond_of_92(92, 1, doubt(Cause::Evidence))]
#[case::one_beyond_of_93(93, 1, PASS)]
// P(B(93, 5 %) ≥ 9) = 0.045 and P(B(93, 5 %) ≥ 8) = 0.10.
#[case::eight_beyond(93, 8, doubt(Cause::Evidence))]
#[case::nine_beyond(93, 9, FAIL)]
fn a_quantile_is_demonstrated_by_ranks(
    #[case] count: u32,
    #[case] beyond: usize,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = "metric = \"settling_time_ms\", at_most = 2.0, over = \"quantile\"";
    let values: Vec<f64> = (0..count as usize).map(|index| if index < beyond { 3.0 } else { 1.9 }).collect();
    assert_eq!(verdict(&spread(expect, count), &trials(&values)), expected);
    // A trial that never settled is as bad as one that settled too late.
    let mut never = trials(&values);
    for trial in never.iter_mut().take(beyond) {
        trial.measures = vec![Measure::Missing("never")];
    }
    assert_eq!(verdict(&spread(expect, count), &never), expected);
    let text = serde_json::to_string(&judged(&spread(expect, count), &never)).unwrap();
    assert!(serde_json::from_str::<ExpectationRecord>(&text).is_ok(), "{text}");
    // The other way round: 5 % are at most that low.
    let mirrored = "metric = \"settling_time_ms\", at_least = 2.0, over = \"quantile\", quantile = 0.05";
    let values: Vec<f64> = values.iter().map(|value| 4.0 - value).collect();
    let scenario = spread(mirrored, count);
    assert_eq!(verdict(&scenario, &trials(&values)), expected);
    let mut never = trials(&values);
    for trial in never.iter_mut().take(beyond) {
        trial.measures = vec![Measure::Missing("never")];
    }
    assert_eq!(verdict(&scenario, &never), expected);
}

#[test]
fn a_mean_or_a_quantile_of_what_cannot_vary_needs_one_trial() {
    for over in ["mean", "quantile"] {
        let expect = format!("metric = \"settling_time_ms\", at_most = 2.0, over = \"{over}\"");
        let scenario = Build { expect: &[&expect], ..ONE }.scenario();
        assert_eq!(verdict(&scenario, &trials(&[2.0])), PASS);
        assert_eq!(verdict(&scenario, &trials(&[2.0_f64.next_up()])), FAIL);
        assert_eq!(verdict(&spread(&expect, 1), &trials(&[1.0])), doubt(Cause::Evidence));
        let never = [trial(0, &[Measure::Missing("never")])];
        assert_eq!(verdict(&scenario, &never), FAIL);
    }
}

#[test]
fn errors_by_trial_have_the_bench_s_own_error_around_them() {
    let expect = "metric = \"static_error_percent\", at_most = 1.0, over = \"each\"";
    let scenario = Build { expect: &[expect], ..ONE }.scenario();
    for (error, expected) in [
        (1.0 - 2e-4 - 1e-9, PASS),
        (-1.0 + 2e-4 + 1e-9, PASS),
        (1.0 - 1e-4, doubt(Cause::Evidence)),
        (-1.0 - 1e-4, doubt(Cause::Evidence)),
        (1.0 + 2e-4 + 1e-9, FAIL),
    ] {
        assert_eq!(verdict(&scenario, &trials(&[error])), expected, "{error}");
    }
}

/// A limit inside the two samples between which the plate settled decides nothing.
#[rstest]
#[case("at_most = 2.0", [1.0, 2.0], PASS)]
#[case("at_most = 2.0", [1.0, 2.0_f64.next_up()], doubt(Cause::Evidence))]
#[case("at_most = 2.0", [2.0, 3.0], doubt(Cause::Evidence))]
#[case("at_most = 2.0", [2.0_f64.next_up(), 3.0], FAIL)]
#[case("at_least = 2.0", [2.0, 3.0], PASS)]
#[case("at_least = 2.0", [1.0, 3.0], doubt(Cause::Evidence))]
#[case("at_least = 2.0", [1.0, 1.5], FAIL)]
#[case("within = [1.0, 3.0]", [1.0, 3.0], PASS)]
#[case("within = [1.5, 3.0]", [1.0, 3.0], doubt(Cause::Evidence))]
fn what_samples_leave_open_stays_open(
    #[case] limit: &str,
    #[case] between: [f64; 2],
    #[case] expected: (Verdict, Option<Cause>),
) {
    let scenario = Build { expect: &[&format!("metric = \"settling_time_ms\", {limit}")], ..ONE }.scenario();
    let sampled = [trial(0, &[Measure::Between(between)])];
    assert_eq!(verdict(&scenario, &sampled), expected);
    assert_eq!(judged(&scenario, &sampled).interval, Some(between));
    // The mean of thirty such trials is as open as they are.
    let scenario = spread(&format!("metric = \"settling_time_ms\", {limit}, over = \"mean\""), 30);
    let many: Vec<_> = (0..30).map(|index| trial(index, &[Measure::Between(between)])).collect();
    assert_eq!(verdict(&scenario, &many), expected);
}

#[test]
fn an_agreement_says_how_much_it_is_worth() {
    let scenario = spread("metric = \"repeatability_percent\", about = 1.3", 30);
    let evidence = judged(&scenario, &trials(&with_moments(30, 100.0, 1.3))).evidence;
    assert!(evidence.power.unwrap() > 0.99, "{evidence:?}");
    assert_eq!(evidence.method.as_deref(), Some("chi-square"));
    assert!(evidence.says.unwrap().starts_with("half or double of 1.3 would have been noticed in 99."));
    let few =
        judged(&spread("metric = \"repeatability_percent\", about = 1.3", 5), &trials(&with_moments(5, 100.0, 1.3)));
    assert!(few.evidence.power.unwrap() < 0.7 && few.verdict == Verdict::Inconclusive);
}
