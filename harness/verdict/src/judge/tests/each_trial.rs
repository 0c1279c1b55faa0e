use super::*;

#[rstest]
#[case("at_most = 3.0", 3.0, true)]
#[case("at_most = 3.0", 3.0_f64.next_up(), false)]
#[case("at_least = 3.0", 3.0, true)]
#[case("at_least = 3.0", 3.0_f64.next_down(), false)]
#[case("within = [2.0, 3.0]", 2.0, true)]
#[case("within = [2.0, 3.0]", 2.0_f64.next_down(), false)]
#[case("within = [2.0, 3.0]", 3.0, true)]
#[case("within = [2.0, 3.0]", 3.0_f64.next_up(), false)]
#[case("about = 2.0, tolerance_percent = 50.0", 1.0, true)]
#[case("about = 2.0, tolerance_percent = 50.0", 1.0_f64.next_down(), false)]
#[case("about = 2.0, tolerance_percent = 50.0", 3.0, true)]
#[case("about = 2.0, tolerance_percent = 50.0", 3.0_f64.next_up(), false)]
fn the_limit_is_good_and_the_next_float_is_not(#[case] limit: &str, #[case] value: f64, #[case] good: bool) {
    let scenario = fixed_scenario(&format!("metric = \"final_amplitude_um\", {limit}"));
    assert_eq!(decide(&scenario, &[value]), if good { PASS } else { FAIL });
}

#[test]
fn one_bad_trial_among_thirty_fails() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let mut values = [1.9; 30];
    assert_eq!(decide(&scenario, &values), PASS);
    values[17] = 2.1;
    let record = judge_values(&scenario, &values);
    assert_eq!((record.verdict, record.value, record.interval), (Verdict::Fail, Some(2.1), Some([1.9, 2.1])));
    assert_eq!(record.reason.map(|reason| reason.to_string()).as_deref(), Some("trial 17: 2.1000, expected ≤ 2"));
    assert_eq!((record.statistic, record.confidence), (Statistic::Worst, Some(0.95)));
    let mut never = trials_with_values(&[1.9; 30]);
    never[29].measures = vec![Measure::Missing(MissingValue::NeverSettles)];
    let record = judge_single_expectation(&scenario, &never);
    assert_eq!((record.verdict, record.value), (Verdict::Fail, None));
    assert_eq!(
        record.reason.map(|reason| reason.to_string()).as_deref(),
        Some("trial 29: never stays inside the band")
    );
}

#[rstest]
#[case("each", "trial 1: 5.0000, expected ≤ 2; the controller stopped: a value that is not finite")]
#[case(
    "mean",
    "5.0000, between 5.0000 and 5.0000, expected ≤ 2; in trial 1 the controller stopped: a value that is not \
                finite"
)]
fn a_stop_of_the_controller_is_part_of_the_reason(#[case] over: &str, #[case] expected: &str) {
    let expect = format!("metric = \"final_amplitude_um\", at_most = 2.0, over = \"{over}\"");
    let scenario = ScenarioBuilder { expect: &[&expect], trials: 2, ..BASE }.scenario();
    let mut trials = trials_with_values(&[5.0, 5.0]);
    trials[1].stopped = Some("a value that is not finite".to_owned());
    trials[1].index = 1;
    if over == "each" {
        trials[0].measures = vec![Measure::Value(1.0)];
    }
    let record = judge_single_expectation(&scenario, &trials);
    assert_eq!(record.reason.map(|reason| reason.to_string()).as_deref(), Some(expected));
}

#[test]
fn a_divergence_is_the_reason_of_a_failure() {
    let diverged = |mut trials: Vec<TrialMeasures>, which: &[usize]| {
        for &index in which {
            trials[index].divergence = Some(Divergence { at_s: 0.0125, is_non_finite: false });
        }
        trials
    };
    let each = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    assert_eq!(verdict_and_cause(&each, &diverged(trials_with_values(&[1.9; 3]), &[1])), PASS);
    let reason = |scenario: &Scenario, trials: &[TrialMeasures]| {
        judge_single_expectation(scenario, trials).reason.unwrap().to_string()
    };
    let missed = diverged(trials_with_values(&[1.9, 2.1, 1.9]), &[1]);
    assert_eq!(reason(&each, &missed), "trial 1: diverged at t = 12.5 ms: 2.1000, expected ≤ 2");
    let mut never = missed;
    never[1].measures = vec![Measure::Missing(MissingValue::NeverSettles)];
    assert_eq!(reason(&each, &never), "trial 1: diverged at t = 12.5 ms: never stays inside the band");
    never[1].measures = vec![Measure::Undefined(UndefinedValue::NoSetpointStep)];
    assert_eq!(reason(&each, &never), "trial 1: the setpoint never steps");
    never[1].measures = vec![Measure::Value(9.0)];
    never[1].excuses = vec![Some(TOO_WEAK)];
    assert_eq!(reason(&each, &never), TOO_WEAK.to_string());
    let mean = varied_scenario("metric = \"static_error_percent\", at_most = 2.0", 4);
    let values = [30.0, 31.0, 29.0, 30.5];
    let plain = reason(&mean, &trials_with_values(&values));
    let one = reason(&mean, &diverged(trials_with_values(&values), &[2]));
    assert_eq!(one, format!("{plain}: trial 2 diverged at t = 12.5 ms"));
    let more = reason(&mean, &diverged(trials_with_values(&values), &[1, 2, 3]));
    assert_eq!(more, format!("{plain}: trial 1 diverged at t = 12.5 ms, and 2 more trials diverged"));
    assert_eq!(verdict_and_cause(&mean, &diverged(trials_with_values(&[0.1, 0.11, 0.12, 0.1]), &[1, 2, 3])), PASS);
}

#[test]
fn a_violation_fails_a_trial() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    let violation = Violation { kind: ViolationKind::WrongSequence, at_s: 0.012, count: 2, worst: None, limit: None };
    let mut trials = trials_with_values(&[1.9; 3]);
    assert_eq!(verdict_and_cause(&scenario, &trials), PASS);
    trials[1].violations = vec![violation];
    assert_eq!(verdict_and_cause(&scenario, &trials), FAIL);
    trials[1].exclusion = Some(Exclusion::NoAnswer { at_ms: 12.0 });
    trials[1].excuses = vec![Some(TOO_WEAK)];
    let record = judge_single_expectation(&scenario, &trials);
    assert_eq!((record.verdict, record.reason), (Verdict::Fail, Some(Reason::Violation { trial: 1, violation })));
    let trial = trial_record(&scenario, &trials[1], Telemetry::default(), String::new(), None);
    assert_eq!(trial.reason, Some(TrialReason::Violation(violation)));
}

#[test]
fn a_failure_outweighs_a_trial_without_a_number() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    let undefined = Measure::Undefined(UndefinedValue::NoSetpointStep);
    let with = |others: [Measure; 2]| -> Vec<_> {
        (0..)
            .zip([undefined.clone()].into_iter().chain(others))
            .map(|(index, measure)| trial_measures(index, &[measure]))
            .collect()
    };
    assert_eq!(
        verdict_and_cause(&scenario, &with([Measure::Value(1.0), Measure::Value(1.0)])),
        inconclusive(Cause::Evidence)
    );
    assert_eq!(verdict_and_cause(&scenario, &with([Measure::Value(1.0), Measure::Value(9.0)])), FAIL);
    assert_eq!(
        verdict_and_cause(&scenario, &with([Measure::Missing(MissingValue::NotRunning), Measure::Value(1.0)])),
        FAIL
    );
}

#[rstest]
#[case::settling("metric = \"settling_time_ms\", at_most = 2.0")]
#[case::mean("metric = \"static_error_percent\", at_most = 2.0")]
#[case::deviation("metric = \"repeatability_percent\", at_most = 2.0")]
fn no_measure_is_never_a_pass(#[case] expect: &str) {
    for count in [1, 30] {
        assert_eq!(verdict_and_cause(&varied_scenario(expect, count), &[]), inconclusive(Cause::Evidence));
    }
    let scenario = fixed_scenario(expect);
    assert_eq!(verdict_and_cause(&scenario, &[]), inconclusive(Cause::Evidence));
    let undefined = [
        trial_measures(0, &[Measure::Undefined(UndefinedValue::NotReported)]),
        trial_measures(1, &[Measure::Undefined(UndefinedValue::NotReported)]),
    ];
    assert_eq!(verdict_and_cause(&scenario, &undefined), inconclusive(Cause::Evidence));
    assert_eq!(judge(&Scenario { expectations: Vec::new(), ..scenario }, &undefined).verdict, Verdict::Inconclusive);
}

#[test]
fn a_killed_run_can_fail_but_not_pass() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let record = judge_values(&scenario, &[1.0; 29]);
    assert_eq!((record.verdict, record.cause), inconclusive(Cause::Evidence));
    assert_eq!(record.reason.map(|reason| reason.to_string()).as_deref(), Some("29 of 30 trials were played"));
    assert_eq!(decide(&scenario, &[9.0; 29]), FAIL);
    assert_eq!(decide(&scenario, &[1.0; 30]), PASS);
}

#[test]
fn a_stopped_controller_fails() {
    let expect: Vec<String> = Metric::ALL
        .iter()
        .filter(|metric| {
            let of_the_line = [Metric::ShutdownTime, Metric::MissedReplies, Metric::EnableOff, Metric::Text];
            !matches!(metric, Metric::Overruns | Metric::RestDrive) && !of_the_line.contains(metric)
        })
        .map(|metric| {
            format!(
                "metric = \"{metric}\", at_most = 99.0{}",
                if matches!(metric, Metric::RecoveryTime | Metric::PeakDeviation) { ", from_ms = 1.0" } else { "" }
            )
        })
        .collect();
    let expect: Vec<_> = expect.iter().map(String::as_str).collect();
    let scenario = ScenarioBuilder { expect: &expect, trials: 2, ..BASE }.scenario();
    let mut rows = trace_rows(&scenario, |_| 2.0);
    for row in rows.iter_mut().skip(900) {
        (row.flags, row.drive_vpp) = (Flags::SAFE, 0.0);
    }
    for record in judge(&scenario, &[measure(&scenario, 0, &rows, &Telemetry::default())]).expectations {
        assert_eq!(record.verdict, Verdict::Fail, "{record:?}");
    }
}
