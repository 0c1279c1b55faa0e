use super::*;

fn trials(signals: &[Vec<f64>]) -> Vec<TrialMeasures> {
    (0..).zip(signals).map(|(index, signal)| trial_measures(index, &[Measure::Samples(signal.clone())])).collect()
}

#[rstest]
#[case::equal(&[vec![1.0, 2.0], vec![1.0, 2.0], vec![1.0, 2.0]], PASS)]
#[case::at_the_limit(&[vec![1.0, 2.0], vec![1.0, 2.25], vec![1.0, 2.0]], PASS)]
#[case::in_one_sample(&[vec![1.0, 2.0], vec![1.0, 2.0], vec![1.0, 1.7]], FAIL)]
#[case::another_length(&[vec![1.0, 2.0], vec![1.0, 2.0], vec![1.0]], FAIL)]
#[case::a_single_trial(&[vec![1.0, 2.0]], inconclusive(Cause::Evidence))]
fn compares_each_trial_with_the_first(#[case] signals: &[Vec<f64>], #[case] expected: (Verdict, Option<Cause>)) {
    let expect = &["metric = \"trial_difference_um\", at_most = 0.25"];
    let scenario = ScenarioBuilder { expect, trials: 3, ..BASE }.scenario();
    assert_eq!(verdict_and_cause(&scenario, &trials(signals)), expected);
}

#[test]
fn reports_the_largest_difference_and_its_trial() {
    let expect = &["metric = \"trial_difference_um\", at_most = 0.25"];
    let scenario = ScenarioBuilder { expect, trials: 3, ..BASE }.scenario();
    let record = judge_single_expectation(&scenario, &trials(&[vec![1.0], vec![1.5], vec![1.3]]));
    assert_eq!(record.value, Some(0.5));
    assert!(matches!(record.reason, Some(Reason::Trial { trial: 1, .. })), "{:?}", record.reason);
}

#[test]
fn measures_the_signal_at_control_instants_of_the_window() {
    let expect = &["metric = \"trial_difference_um\", at_most = 0.25, from_ms = 1.0, signal = \"wd_um\""];
    let scenario = ScenarioBuilder { expect, trials: 2, ..BASE }.scenario();
    let row = |t_ms: f64, wd_um: f64, flags| Row { t_s: t_ms / 1e3, wd_um, flags, ..Row::default() };
    let control = Flags::CONTROL;
    let rows = [row(0.0, 1.0, control), row(1.0, 2.0, control), row(1.5, 3.0, Flags::empty()), row(2.0, 4.0, control)];
    let measures = measure(&scenario, 0, &rows, &Telemetry::default()).measures;
    assert_eq!(measures, [Measure::Samples(vec![2.0, 4.0])]);
}

#[test]
fn another_trial_is_measured_later_and_in_proportion() {
    let expect = &["metric = \"trial_difference_um\", at_most = 0.25"];
    let mut scenario = ScenarioBuilder { expect, trials: 2, ..BASE }.scenario();
    let mut others = scenario.clone();
    let comparison = &mut others.expectations[0].comparison;
    (comparison.amplitude_factor, comparison.later) = (0.5, Time::from_nanos(300_000));
    scenario.other_trials = Some(Box::new(others));
    let row = |t_ms: f64, amplitude_um, flags| Row { t_s: t_ms / 1e3, amplitude_um, flags, ..Row::default() };
    let (control, none) = (Flags::CONTROL, Flags::empty());
    let rows = [
        row(0.0, 1.0, control),
        row(0.3, 2.0, none),
        row(1.0, 3.0, control),
        row(1.2, 4.0, none),
        row(1.3, 5.0, none),
        row(1.4, 6.0, none),
    ];
    let samples = |index| measure(&scenario, index, &rows, &Telemetry::default()).measures;
    assert_eq!(samples(0), [Measure::Samples(vec![1.0, 3.0])]);
    assert_eq!(samples(1), [Measure::Samples(vec![4.0, 10.0])]);
}
