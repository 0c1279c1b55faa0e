use super::*;
use platebench_model::record::{SignalPoint, WorstInstant};

#[test]
fn a_divergence_is_recorded_with_its_trial() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 1);
    let mut trial = trial_measures(0, &[Measure::Missing(MissingValue::NeverSettles)]);
    let record = |trial: &TrialMeasures| {
        trial_record(&scenario, trial, Telemetry::default(), "traces/s/000.csv".to_owned(), None)
    };
    assert!(!serde_json::to_string(&record(&trial)).unwrap().contains("diverged"));
    trial.divergence = Some(Divergence { at_s: 0.003, is_non_finite: false });
    let text = serde_json::to_string(&record(&trial)).unwrap();
    assert!(text.contains(
        r#""reason":"diverged at t = 3.0 ms","reason_code":{"diverged":{"at_s":0.003,"is_non_finite":false}}"#
    ));
    assert!(text.contains(r#""diverged_at_s":0.003"#), "{text}");
}

#[test]
fn a_confidence_close_to_1_is_inconclusive_in_json() {
    for metric in ["repeatability_percent", "static_error_percent"] {
        let scenario =
            varied_scenario(&format!("metric = \"{metric}\", at_most = 1.3, confidence = 0.9999999999999999"), 3);
        let record = judge_values(&scenario, &[0.1, 0.2, 0.3]);
        assert_eq!((record.verdict, record.cause), inconclusive(Cause::Evidence));
        let text = serde_json::to_string(&record).unwrap();
        assert_eq!(serde_json::from_str::<ExpectationRecord>(&text).unwrap().verdict, Verdict::Inconclusive, "{text}");
    }
}

#[test]
fn writes_a_readable_record_of_a_huge_number() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 2);
    let record = judge_values(&scenario, &[f64::MAX, f64::MAX]);
    assert_ne!(record.verdict, Verdict::Pass);
    let text = serde_json::to_string(&record).unwrap();
    assert!(serde_json::from_str::<ExpectationRecord>(&text).is_ok(), "{text}");
}

#[test]
fn numbers_repeated_metrics_from_the_second() {
    let expect = [
        "metric = \"settling_time_ms\", at_most = 2.0",
        "metric = \"static_error_percent\", at_most = 2.0",
        "metric = \"settling_time_ms\", at_most = 5.0, band_percent = 1.0",
        "metric = \"repeatability_percent\", at_most = 2.0",
        "metric = \"settling_time_ms\", at_most = 5.0, from_ms = 30.0",
    ];
    let scenario = ScenarioBuilder { expect: &expect, ..BASE }.scenario();
    let measures = [
        Measure::Value(1.93),
        Measure::Value(-0.5),
        Measure::Missing(MissingValue::NotRunning),
        Measure::Value(99.5),
        Measure::Value(4.0),
    ];
    let trial = trial_measures(0, &measures);
    let record = trial_record(&scenario, &trial, Telemetry::default(), "traces/s/000.csv".to_owned(), None);
    let text = serde_json::to_string(&record.metrics).unwrap();
    assert_eq!(
        text,
        r#"{"settling_time_ms":1.93,"static_error_percent":0.5,"settling_time_ms[2]":null,"settling_time_ms[3]":4.0}"#
    );
}

#[rstest]
#[case("metric = \"settling_time_ms\", at_most = 2.0", (None, Some(5.0), Some("amplitude_um")))]
#[case("metric = \"settling_time_ms\", at_most = 2.0, from_ms = 20.0, band_percent = 1.0, signal = \"wd_um\"",
    (Some(20.0), Some(1.0), Some("wd_um")))]
#[case("metric = \"overshoot_percent\", at_most = 2.0, from_ms = 3.0", (Some(3.0), None, Some("amplitude_um")))]
#[case("metric = \"drive_peak_vpp\", at_most = 900.0", (None, None, None))]
fn records_the_options_of_a_metric(#[case] expect: &str, #[case] expected: (Option<f64>, Option<f64>, Option<&str>)) {
    let scenario = fixed_scenario(expect);
    let found = judge_values(&scenario, &[1.0]).definition;
    assert_eq!((found.from_ms, found.band_percent, found.signal.as_deref()), expected);
}

#[rstest]
#[case::worst("metric = \"settling_time_ms\", at_most = 2.0", &[1.0, 1.5], Some(0.25))]
#[case::mean("metric = \"static_error_percent\", at_most = 2.0", &[0.5, -1.5], Some(0.5))]
#[case::failed("metric = \"settling_time_ms\", at_most = 2.0", &[3.0, 1.0], Some(-0.5))]
#[case::no_tolerance("metric = \"repeatability_percent\", about = 1.3", &[1.0, 2.0], None)]
fn records_the_margin_of_the_deciding_value(
    #[case] expect: &str,
    #[case] values: &[f64],
    #[case] expected: Option<f64>,
) {
    let record = judge_values(&varied_scenario(expect, 2), values);
    assert_eq!(record.margin, expected, "{record:?}");
}

#[rstest]
#[case::each("metric = \"settling_time_ms\", at_most = 2.0")]
#[case::mean("metric = \"static_error_percent\", at_most = 2.0")]
fn a_scenario_without_trials_was_not_played(#[case] expect: &str) {
    let record = judge_single_expectation(&varied_scenario(expect, 3), &[]);
    assert_eq!((record.verdict, record.cause), inconclusive(Cause::Evidence));
    assert_eq!(record.reason.unwrap().to_string(), "0 of 3 trials were played");
}

/// The trials have an instant each at their index in ms; trial 2 does not count.
#[rstest]
#[case::worst_trial("metric = \"settling_time_ms\", at_most = 2.0", [1.0, 3.0, 9.0, 2.5], 1)]
#[case::farthest_of_a_mean("metric = \"static_error_percent\", at_most = 1.0", [1.0, 0.5, 9.0, -3.0], 3)]
#[case::first_of_equal("metric = \"settling_time_ms\", at_most = 2.0", [1.0, 1.0, 1.0, 1.0], 0)]
fn records_the_worst_instant_of_the_deciding_trial(
    #[case] expect: &str,
    #[case] values: [f64; 4],
    #[case] deciding: u32,
) {
    let scenario = varied_scenario(expect, 4);
    let mut trials = trials_with_values(&values);
    for trial in &mut trials {
        let points = vec![SignalPoint { t_ms: f64::from(trial.index), value: 1.0 }];
        trial.worst = vec![Some(WorstInstant { trial: trial.index, window_ms: [0.0, 60.0], points })];
    }
    let worst = |trials: &[TrialMeasures]| judge_single_expectation(&scenario, trials).worst.unwrap();
    trials[2].measures = vec![Measure::Value(0.0)];
    assert_eq!(worst(&trials).trial, deciding);
    assert_eq!(worst(&trials).points[0].t_ms, f64::from(deciding));
    trials[2].exclusion = Some(Exclusion::NoAnswer { at_ms: 1.0 });
    let excluded = judge_single_expectation(&scenario, &trials);
    let decided = if excluded.verdict == Verdict::Fail { deciding } else { 2 };
    assert_eq!(excluded.worst.unwrap().trial, decided);
}
