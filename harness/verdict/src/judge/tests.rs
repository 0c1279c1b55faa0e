use super::*;
use crate::metrics::Measure;
use crate::statistics::SampleSummary;
use crate::trial::{measure, trial_record};
use platebench_plate::Time;
use platebench_record::{
    BestResponse, Divergence, Exclusion, Excuse, MissingValue, Reason, Statistic, Telemetry, TrialReason,
    UndefinedValue, Violation, ViolationKind,
};
use platebench_scenario::Metric;
use platebench_trace::{Flags, Row};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rstest::rstest;
use tempfile::TempDir;

mod over_trials;
mod sequential;

const PLATE: &str = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");

/// A scenario with the given expectations, as TOML inline tables, and changes to the text.
struct ScenarioBuilder<'a> {
    expect: &'a [&'a str],
    trials: u32,
    max_count: u32,
    is_varied: bool,
    limit_vpp: f64,
    setpoint: &'a str,
    force: &'a str,
}

const BASE: ScenarioBuilder<'_> = ScenarioBuilder {
    expect: &[],
    trials: 1,
    max_count: 0,
    is_varied: false,
    limit_vpp: 900.0,
    setpoint: "2.0",
    force: "0.0",
};

impl ScenarioBuilder<'_> {
    fn scenario(&self) -> Scenario {
        let folder = TempDir::new().unwrap();
        let limit = "limit_vpp = 900.0";
        assert!(PLATE.contains(limit));
        let plate = PLATE.replace(limit, &format!("limit_vpp = {:?}", self.limit_vpp));
        std::fs::write(folder.path().join("plate.toml"), plate).unwrap();
        let spread = if self.is_varied { "[trials.spread]\nsensor_gain_percent = 1.2\n" } else { "" };
        let text = format!(
            "title = \"Synthetic\"\nplate = \"plate.toml\"\nduration_ms = 60.0\nexpect = [{}]\n[profile]\nsetpoint_um = {}\n\
             finger_force_n = {}\n[trials]\ncount = {}\nmax_count = {}\n{spread}",
            self.expect.iter().map(|expect| format!("{{ {expect} }}")).collect::<Vec<_>>().join(", "),
            self.setpoint,
            self.force,
            self.trials,
            self.max_count.max(self.trials)
        );
        let path = folder.path().join("s.toml");
        std::fs::write(&path, text).unwrap();
        platebench_scenario::load(&path, "s.toml").unwrap_or_else(|fault| panic!("{}", fault.render(false)))
    }
}

/// A scenario of `trials` trials that differ, with one expectation.
fn varied_scenario(expect: &str, trials: u32) -> Scenario {
    ScenarioBuilder { expect: &[expect], trials, is_varied: true, ..BASE }.scenario()
}

fn trial_measures(index: u32, measures: &[Measure]) -> TrialMeasures {
    TrialMeasures {
        telemetry: Telemetry::default(),
        index,
        seed: u64::from(index) + 1,
        measures: measures.to_vec(),
        excuses: vec![None; measures.len()],
        divergence: None,
        exclusion: None,
        is_real_plate: false,
    }
}

fn trials_with_values(values: &[f64]) -> Vec<TrialMeasures> {
    (0..).zip(values).map(|(index, value)| trial_measures(index, &[Measure::Value(*value)])).collect()
}

fn judge_single_expectation(scenario: &Scenario, trials: &[TrialMeasures]) -> ExpectationRecord {
    let judgement = judge(scenario, trials);
    assert_eq!(
        judgement.verdict,
        Verdict::combine(judgement.expectations.iter().map(|expectation| expectation.verdict))
    );
    judgement.expectations.into_iter().next().unwrap()
}

fn verdict_and_cause(scenario: &Scenario, trials: &[TrialMeasures]) -> (Verdict, Option<Cause>) {
    let record = judge_single_expectation(scenario, trials);
    assert_eq!(record.cause.is_some(), record.verdict == Verdict::Inconclusive, "{record:?}");
    assert_eq!(record.reason.is_none(), record.verdict == Verdict::Pass, "{record:?}");
    (record.verdict, record.cause)
}

const TOO_WEAK: Excuse =
    Excuse::DriveLimited { limit_vpp: 400.0, best: BestResponse::Missing(MissingValue::NeverSettles) };
const PASS: (Verdict, Option<Cause>) = (Verdict::Pass, None);
const FAIL: (Verdict, Option<Cause>) = (Verdict::Fail, None);
const fn inconclusive(cause: Cause) -> (Verdict, Option<Cause>) {
    (Verdict::Inconclusive, Some(cause))
}

/// `count` values with exactly this mean and standard deviation.
fn values_with_moments(count: usize, mean: f64, deviation: f64) -> Vec<f64> {
    let raw: Vec<f64> = (0..count).map(|index| index as f64).collect();
    let summary = SampleSummary::of(&raw).unwrap();
    raw.iter().map(|value| mean + (value - summary.mean) / summary.deviation * deviation).collect()
}

/// A trial whose amplitude follows `amplitude` of the time in ms, with a row every 0.05 ms.
fn trace_rows(scenario: &Scenario, amplitude: impl Fn(f64) -> f64) -> Vec<Row> {
    let instants = (0..=1_200_u64).map(|index| Time::from_nanos(index * 50_000));
    let row = |time: Time| Row {
        t_s: time.seconds(),
        setpoint_um: scenario.setpoint.at(time),
        amplitude_um: amplitude(time.ms()),
        drive_vpp: 100.0,
        flags: Flags::CONTROL,
        ..Row::default()
    };
    instants.map(row).collect()
}

fn set_saturated(mut rows: Vec<Row>) -> Vec<Row> {
    rows[0].flags |= Flags::SATURATED;
    rows
}

fn judge_rows(scenario: &Scenario, rows: &[Row]) -> (Verdict, Option<Cause>) {
    verdict_and_cause(scenario, &[measure(scenario, 0, rows, &Telemetry::default())])
}

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
fn exactly_at_the_limit_is_good_and_the_next_float_is_not(#[case] limit: &str, #[case] value: f64, #[case] good: bool) {
    let scenario =
        ScenarioBuilder { expect: &[&format!("metric = \"final_amplitude_um\", {limit}")], ..BASE }.scenario();
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[value])), if good { PASS } else { FAIL });
}

#[test]
fn one_bad_trial_among_thirty_fails() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let mut values = [1.9; 30];
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&values)), PASS);
    values[17] = 2.1;
    let record = judge_single_expectation(&scenario, &trials_with_values(&values));
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

/// It fails nothing by itself, whatever the statistic, and an excuse or a doubt stands as it did.
#[test]
fn a_divergence_is_why_an_expectation_failed() {
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
fn a_divergence_is_recorded_with_its_trial() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 1);
    let mut trial = trial_measures(0, &[Measure::Missing(MissingValue::NeverSettles)]);
    let record = |trial: &TrialMeasures| trial_record(&scenario, trial, "traces/s/000.csv".to_owned(), None);
    assert!(!serde_json::to_string(&record(&trial)).unwrap().contains("diverged"));
    trial.divergence = Some(Divergence { at_s: 0.003, is_non_finite: false });
    let text = serde_json::to_string(&record(&trial)).unwrap();
    assert!(text.contains(
        r#""reason":"diverged at t = 3.0 ms","reason_code":{"diverged":{"at_s":0.003,"is_non_finite":false}}"#
    ));
    assert!(text.contains(r#""diverged_at_s":0.003"#), "{text}");
}

#[test]
fn a_violation_fails_a_trial_whatever_it_measured() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    let violation = Violation { kind: ViolationKind::WrongSequence, at_s: 0.012, count: 2, worst: None, limit: None };
    let mut trials = trials_with_values(&[1.9; 3]);
    assert_eq!(verdict_and_cause(&scenario, &trials), PASS);
    trials[1].telemetry.violations = vec![violation];
    assert_eq!(verdict_and_cause(&scenario, &trials), FAIL);
    trials[1].exclusion = Some(Exclusion::NoAnswer { at_ms: 12.0 });
    trials[1].excuses = vec![Some(TOO_WEAK)];
    let record = judge_single_expectation(&scenario, &trials);
    assert_eq!((record.verdict, record.reason), (Verdict::Fail, Some(Reason::Violation { trial: 1, violation })));
    let trial = trial_record(&scenario, &trials[1], String::new(), None);
    assert_eq!(trial.reason, Some(TrialReason::Violation(violation)));
}

#[test]
fn a_failure_weighs_more_than_a_trial_without_a_number() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    let undefined = Measure::Undefined(UndefinedValue::NoSetpointStep);
    let with = |others: [Measure; 2]| -> Vec<_> {
        (0..)
            .zip([undefined].into_iter().chain(others))
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
fn nothing_measured_is_never_a_pass(#[case] expect: &str) {
    for count in [1, 30] {
        assert_eq!(verdict_and_cause(&varied_scenario(expect, count), &[]), inconclusive(Cause::Evidence));
    }
    let scenario = ScenarioBuilder { expect: &[expect], ..BASE }.scenario();
    assert_eq!(verdict_and_cause(&scenario, &[]), inconclusive(Cause::Evidence));
    let undefined = [
        trial_measures(0, &[Measure::Undefined(UndefinedValue::NotReported)]),
        trial_measures(1, &[Measure::Undefined(UndefinedValue::NotReported)]),
    ];
    assert_eq!(verdict_and_cause(&scenario, &undefined), inconclusive(Cause::Evidence));
    assert_eq!(judge(&Scenario { expectations: Vec::new(), ..scenario }, &undefined).verdict, Verdict::Inconclusive);
}

#[test]
fn a_run_that_was_killed_has_passed_nothing_but_may_have_failed() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 30);
    let record = judge_single_expectation(&scenario, &trials_with_values(&[1.0; 29]));
    assert_eq!((record.verdict, record.cause), inconclusive(Cause::Evidence));
    assert_eq!(record.reason.map(|reason| reason.to_string()).as_deref(), Some("29 of 30 trials were played"));
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[9.0; 29])), FAIL);
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[1.0; 30])), PASS);
}

/// The quantile of Student's t at 95 % and 29 degrees of freedom, from a table.
const T_29: f64 = 1.699_127;

#[rstest]
#[case::pass(0.9, PASS)]
#[case::just_pass(1.0 - 2e-4 - 1e-4, PASS)]
#[case::just_not(1.0 - 2e-4 + 1e-4, inconclusive(Cause::Evidence))]
#[case::on_the_limit(1.0 + 0.1, inconclusive(Cause::Evidence))]
#[case::just_not_fail(1.2 + 2e-4 - 1e-4, inconclusive(Cause::Evidence))]
#[case::just_fail(1.2 + 2e-4 + 1e-4, FAIL)]
fn the_static_error_is_held_against_both_bounds(
    #[case] mean_plus_half: f64,
    #[case] expected: (Verdict, Option<Cause>),
) {
    // Half width 0.1, so that the mean lies 0.1 below.
    let deviation = 0.1 * 30.0_f64.sqrt() / T_29;
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 30);
    for sign in [1.0, -1.0] {
        let values = values_with_moments(30, sign * (mean_plus_half - 0.1), deviation);
        assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&values)), expected);
        let record = judge_single_expectation(&scenario, &trials_with_values(&values));
        assert_eq!((record.statistic, record.confidence), (Statistic::Mean, Some(0.95)));
        assert!((record.value.unwrap() - (mean_plus_half - 0.1).abs()).abs() < 1e-12);
    }
}

#[test]
fn errors_of_opposite_sign_do_not_make_up_for_each_other() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 30);
    let errors: Vec<f64> = (0..30).map(|index| if index % 2 == 0 { 5.0 } else { -5.0 }).collect();
    let record = judge_single_expectation(&scenario, &trials_with_values(&errors));
    assert_eq!((record.verdict, record.value), (Verdict::Fail, Some(5.0)));
}

#[rstest]
#[case("metric = \"static_error_percent\", at_most = 1.0")]
#[case("metric = \"repeatability_percent\", at_most = 1.0")]
fn over_trials_too_a_failure_weighs_more_than_a_doubt(#[case] expect: &str) {
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
fn one_trial_that_could_have_come_out_otherwise_shows_no_mean() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 1);
    let record = judge_single_expectation(&scenario, &trials_with_values(&[0.01]));
    assert_eq!(
        (record.verdict, record.cause, record.value),
        (Verdict::Inconclusive, Some(Cause::Evidence), Some(0.01))
    );
    assert_eq!(
        record.reason.map(|reason| reason.to_string()).as_deref(),
        Some("1 of the trials count, expected at least 2")
    );
}

#[test]
fn where_nothing_is_left_to_chance_one_trial_is_enough() {
    let scenario = ScenarioBuilder { expect: &["metric = \"static_error_percent\", at_most = 1.0"], ..BASE }.scenario();
    for (error, expected) in [
        (0.5, PASS),
        (-0.5, PASS),
        (1.0 - 2e-4 - 1e-9, PASS),
        (1.0, inconclusive(Cause::Evidence)),
        (1.001, FAIL),
        (-1.001, FAIL),
    ] {
        assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[error])), expected, "{error}");
    }
    // Trials that differ although the scenario does not make them: chance is at work after all.
    let scenario =
        ScenarioBuilder { expect: &["metric = \"static_error_percent\", at_most = 1.0"], trials: 2, ..BASE }.scenario();
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[0.5, 0.5])), PASS);
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[0.2, 0.8])), inconclusive(Cause::Evidence));
}

#[rstest]
#[case("at_most = 1.3", 1.015, PASS)]
#[case("at_most = 1.3", 1.017, inconclusive(Cause::Evidence))]
#[case("at_most = 1.3", 1.3, inconclusive(Cause::Evidence))]
// s √(29/χ²) at 95 %: 0.8254 s, so that 1.58 fails and 1.57 does not.
#[case("at_most = 1.3", 1.57, inconclusive(Cause::Evidence))]
#[case("at_most = 1.3", 1.58, FAIL)]
#[case("at_least = 1.0", 1.22, PASS)]
#[case("at_least = 1.0", 1.20, inconclusive(Cause::Evidence))]
#[case("within = [0.5, 2.0]", 1.3, PASS)]
#[case("within = [1.2, 1.4]", 1.3, inconclusive(Cause::Evidence))]
// Two-sided at 95 %: from 0.7964 s to 1.3443 s.
#[case("about = 1.3", 0.968, PASS)]
#[case("about = 1.3", 0.966, FAIL)]
#[case("about = 1.3", 1.631, PASS)]
#[case("about = 1.3", 1.634, FAIL)]
fn repeatability_has_to_be_demonstrated(
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
fn few_trials_agree_with_nothing() {
    for count in [2, 5, 14] {
        let scenario = varied_scenario("metric = \"repeatability_percent\", about = 1.3", count);
        for deviation in [0.6, 0.9, 1.3, 2.0] {
            let (verdict, _) = verdict_and_cause(
                &scenario,
                &trials_with_values(&values_with_moments(count as usize, 100.0, deviation)),
            );
            assert!(verdict != Verdict::Pass || count == 14, "{deviation} over {count} trials");
        }
    }
    let scenario = varied_scenario("metric = \"repeatability_percent\", about = 1.3", 1);
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[100.0])), inconclusive(Cause::Evidence));
}

#[test]
fn what_never_varies_is_not_repeatable() {
    let scenario = varied_scenario("metric = \"repeatability_percent\", at_most = 1.3", 30);
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[100.0; 30])), inconclusive(Cause::Evidence));
    let scenario =
        ScenarioBuilder { expect: &["metric = \"repeatability_percent\", at_most = 1.3"], trials: 30, ..BASE }
            .scenario();
    assert_eq!(verdict_and_cause(&scenario, &trials_with_values(&[100.0; 30])), inconclusive(Cause::Evidence));
}

#[test]
fn a_confidence_next_to_1_ends_in_doubt_and_in_json() {
    for metric in ["repeatability_percent", "static_error_percent"] {
        let scenario =
            varied_scenario(&format!("metric = \"{metric}\", at_most = 1.3, confidence = 0.9999999999999999"), 3);
        let record = judge_single_expectation(&scenario, &trials_with_values(&[0.1, 0.2, 0.3]));
        assert_eq!((record.verdict, record.cause), inconclusive(Cause::Evidence));
        let text = serde_json::to_string(&record).unwrap();
        assert_eq!(serde_json::from_str::<ExpectationRecord>(&text).unwrap().verdict, Verdict::Inconclusive, "{text}");
    }
}

#[test]
fn a_number_beyond_all_bounds_still_makes_a_record_that_can_be_read() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 2);
    let record = judge_single_expectation(&scenario, &trials_with_values(&[f64::MAX, f64::MAX]));
    assert_ne!(record.verdict, Verdict::Pass);
    let text = serde_json::to_string(&record).unwrap();
    assert!(serde_json::from_str::<ExpectationRecord>(&text).is_ok(), "{text}");
}

#[test]
fn what_happened_on_the_way_is_never_a_pass_and_a_failure_stands() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    for exclusion in [Exclusion::NoAnswer { at_ms: 3.0 }, Exclusion::LateBench { count: 1, first_ms: 3.0 }] {
        let cause = exclusion.cause();
        let verdict_with = |values: &[f64]| {
            let mut trials = trials_with_values(values);
            trials[1].exclusion = Some(exclusion.clone());
            verdict_and_cause(&scenario, &trials)
        };
        assert_eq!(verdict_with(&[1.0, 1.0, 1.0]), inconclusive(cause));
        assert_eq!(verdict_with(&[1.0, 9.0, 1.0]), inconclusive(cause), "an excluded trial cannot fail");
        assert_eq!(verdict_with(&[1.0, 1.0, 9.0]), FAIL);
    }
    let mut all = trials_with_values(&[9.0, 9.0, 9.0]);
    for trial in &mut all {
        trial.exclusion = Some(Exclusion::NoAnswer { at_ms: 3.0 });
    }
    assert_eq!(verdict_and_cause(&scenario, &all), inconclusive(Cause::Rig));
}

#[rstest]
#[case::within("{ metric = \"overruns\", at_most = 2.0 }", 2, PASS)]
#[case::beyond("{ metric = \"overruns\", at_most = 2.0 }", 3, inconclusive(Cause::Bench))]
#[case::none_stated("{ metric = \"overshoot_percent\", at_most = 2.0 }", 1, inconclusive(Cause::Bench))]
#[case::the_smallest_counts(
    "{ metric = \"overruns\", at_most = 9.0 }, { metric = \"overruns\", at_most = 1.0 }",
    2,
    inconclusive(Cause::Bench)
)]
fn overruns_are_borne_up_to_what_the_scenario_states(
    #[case] expect: &str,
    #[case] overruns: usize,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = expect.trim_start_matches("{ ").trim_end_matches(" }");
    let scenario = ScenarioBuilder { expect: &[expect], ..BASE }.scenario();
    let mut rows = trace_rows(&scenario, |_| 2.0);
    rows.iter_mut().skip(100).step_by(20).take(overruns).for_each(|row| row.flags |= Flags::OVERRUN);
    assert_eq!(judge_rows(&scenario, &rows), expected);
}

#[test]
fn a_trial_that_lost_rows_on_their_way_does_not_count() {
    let scenario = ScenarioBuilder { expect: &["metric = \"settling_time_ms\", at_most = 2.0"], ..BASE }.scenario();
    let rows = trace_rows(&scenario, |_| 2.0);
    let cause = |lost_rows| {
        let timing = platebench_record::TimingRecord { lost_rows, ..Default::default() };
        let telemetry = Telemetry { timing: Some(timing), ..Telemetry::default() };
        measure(&scenario, 0, &rows, &telemetry).exclusion.as_ref().map(Exclusion::cause)
    };
    assert_eq!((cause(0), cause(1)), (None, Some(Cause::Bench)));
}

/// A stall of 50 ms in 60 ms, 2 %, and four standard errors of 0.5 %.
#[rstest]
#[case::in_step("target", 873_333.0, None)]
#[case::fast("target", 873_334.0, Some(Cause::Rig))]
#[case::slow("target", -873_334.0, Some(Cause::Rig))]
#[case::it_does_not_pace("bench", 1e6, None)]
fn a_target_that_paces_by_a_wrong_clock_plays_another_scenario(
    #[case] pacing: &str,
    #[case] ppm: f64,
    #[case] expected: Option<Cause>,
) {
    let scenario = ScenarioBuilder { expect: &["metric = \"settling_time_ms\", at_most = 2.0"], ..BASE }.scenario();
    let timing = platebench_record::TimingRecord {
        pacing: pacing.to_owned(),
        target_clock_ppm: Some(ppm),
        target_clock_error_ppm: Some(5_000.0),
        ..Default::default()
    };
    let telemetry = Telemetry { timing: Some(timing), ..Telemetry::default() };
    let trial = measure(&scenario, 0, &trace_rows(&scenario, |_| 2.0), &telemetry);
    assert_eq!(trial.exclusion.as_ref().map(Exclusion::cause), expected);
}

#[test]
fn disturbances_are_read_off_the_trace() {
    let scenario = ScenarioBuilder { expect: &["metric = \"settling_time_ms\", at_most = 2.0"], ..BASE }.scenario();
    let good = trace_rows(&scenario, |_| 2.0);
    assert_eq!(judge_rows(&scenario, &good), PASS);
    let flagged = |flag| {
        let mut rows = good.clone();
        rows[700].flags |= flag;
        judge_rows(&scenario, &rows)
    };
    assert_eq!(flagged(Flags::LINK_LOST), inconclusive(Cause::Rig));
    assert_eq!(flagged(Flags::OVERRUN), inconclusive(Cause::Bench));
    assert_eq!(flagged(Flags::LINK_LOST | Flags::OVERRUN), inconclusive(Cause::Rig));
    assert_eq!(flagged(Flags::SATURATED), PASS);
    assert_eq!(judge_rows(&scenario, &good[..1_200]), inconclusive(Cause::Bench), "the last row is missing");
    assert_eq!(judge_rows(&scenario, &good[1..]), inconclusive(Cause::Bench), "the first row is missing");
    assert_eq!(judge_rows(&scenario, &[]), inconclusive(Cause::Bench), "every row is missing");
    let mut gap = good.clone();
    gap.remove(600);
    assert_eq!(judge_rows(&scenario, &gap), inconclusive(Cause::Bench), "a row in the middle is missing");
}

#[rstest]
#[case::before(29, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::first(30, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", true)]
#[case::a_period_later(40, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", true)]
#[case::too_late(41, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::held_up(42, "kind = \"delay\", delay_ms = 2.0, from_ms = 30.0, until_ms = 40.0", true)]
#[case::no_longer_held_up(43, "kind = \"delay\", delay_ms = 2.0, from_ms = 30.0, until_ms = 40.0", false)]
#[case::for_good(30, "kind = \"disconnect\", from_ms = 30.0", false)]
#[case::there_and_back(30, "kind = \"delay\", delay_ms = 0.5, from_ms = 30.0, until_ms = 40.0", true)]
#[case::in_time(
    30,
    "kind = \"delay\", delay_ms = 0.5, direction = \"to-controller\", from_ms = 30.0, until_ms = 40.0",
    false
)]
#[case::doubled(30, "kind = \"duplicate\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::babble(30, "kind = \"babble\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::of_the_sensor(30, "kind = \"freeze\", from_ms = 30.0, until_ms = 40.0", false)]
fn an_answer_that_a_planned_fault_swallowed_is_no_disturbance(
    #[case] at_ms: usize,
    #[case] fault: &str,
    #[case] planned: bool,
) {
    let expect = "metric = \"settling_time_ms\", at_most = 2.0 }]\nfault = [{ ".to_owned() + fault;
    let scenario = ScenarioBuilder { expect: &[&expect], ..BASE }.scenario();
    let mut rows = trace_rows(&scenario, |_| 2.0);
    rows[at_ms * 20].flags |= Flags::LINK_LOST;
    assert_eq!(judge_rows(&scenario, &rows), if planned { PASS } else { inconclusive(Cause::Rig) });
    // One that is planned does not hide one that is not.
    rows[100].flags |= Flags::LINK_LOST;
    assert_eq!(judge_rows(&scenario, &rows), inconclusive(Cause::Rig));
}

#[test]
fn a_controller_that_gave_up_has_failed() {
    let expect: Vec<String> = Metric::ALL
        .into_iter()
        // The last two are there for controllers that stop.
        .filter(|metric| {
            !matches!(metric, Metric::Overruns | Metric::ShutdownTime | Metric::MissedReplies | Metric::RestDrive)
        })
        .map(|metric| {
            format!(
                "metric = \"{metric}\", at_most = 99.0{}",
                if matches!(metric, Metric::RecoveryTime | Metric::PeakDeviation) { ", from_ms = 1.0" } else { "" }
            )
        })
        .collect();
    let expect: Vec<_> = expect.iter().map(String::as_str).collect();
    let scenario = ScenarioBuilder { expect: &expect, ..BASE }.scenario();
    let mut rows = trace_rows(&scenario, |_| 2.0);
    for row in rows.iter_mut().skip(900) {
        (row.flags, row.drive_vpp) = (Flags::SAFE, 0.0);
    }
    for record in judge(&scenario, &[measure(&scenario, 0, &rows, &Telemetry::default())]).expectations {
        assert_eq!(record.verdict, Verdict::Fail, "{record:?}");
    }
}

#[test]
fn giving_up_at_the_limit_is_no_excuse_where_the_demand_could_be_met() {
    for expect in ["metric = \"settling_time_ms\", at_most = 3.0", "metric = \"static_error_percent\", at_most = 1.0"] {
        let scenario = ScenarioBuilder { expect: &[expect], ..BASE }.scenario();
        let mut rows = set_saturated(trace_rows(&scenario, |_| 2.0));
        rows.last_mut().unwrap().flags = Flags::SAFE;
        assert_eq!(judge_rows(&scenario, &rows), FAIL, "{expect}");
    }
}

/// The envelope from rest with all of the drive, then held at the setpoint.
fn fastest_envelope(limit_vpp: f64) -> impl Fn(f64) -> f64 {
    move |t| (0.006_98 * limit_vpp * (1.0 - (-t / 1.88).exp())).min(2.0)
}

#[test]
fn two_newtons_at_400_vpp_cannot_be_held() {
    let expect = ["metric = \"static_error_percent\", at_most = 1.0", "metric = \"overshoot_percent\", at_most = 1.0"];
    let scenario = ScenarioBuilder { expect: &expect, limit_vpp: 400.0, force: "2.0", ..BASE }.scenario();
    let low = trace_rows(&scenario, |_| 1.19);
    assert_eq!(judge_rows(&scenario, &low), FAIL, "never saturated: nobody but the controller");
    let record =
        judge_single_expectation(&scenario, &[measure(&scenario, 0, &set_saturated(low), &Telemetry::default())]);
    assert_eq!((record.verdict, record.cause), inconclusive(Cause::Infeasible));
    let reason = record.reason.unwrap().to_string();
    assert!(reason.contains("needs 669 Vpp, the amplifier gives 400 Vpp"), "{reason}");
    let above = judge(
        &scenario,
        &[measure(&scenario, 0, &set_saturated(trace_rows(&scenario, |_| 2.5)), &Telemetry::default())],
    );
    assert_eq!(above.expectations[1].verdict, Verdict::Fail, "too little drive is no reason to overshoot");
    let feasible = ScenarioBuilder { expect: &expect, limit_vpp: 700.0, force: "2.0", ..BASE }.scenario();
    assert_eq!(
        judge_rows(&feasible, &set_saturated(trace_rows(&feasible, |_| 1.19))),
        FAIL,
        "with 700 Vpp it can be held"
    );
}

#[test]
fn what_the_drive_just_reaches_is_demanded() {
    // 2 N need 668.6 Vpp; 660 Vpp reach 1.974 µm, 1.28 % too low.
    for (at_most, expected) in [(1.4, FAIL), (1.2, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"static_error_percent\", at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 660.0, force: "2.0", ..BASE }.scenario();
        assert_eq!(judge_rows(&scenario, &set_saturated(trace_rows(&scenario, |_| 1.6))), expected, "{at_most}");
    }
}

#[test]
fn nobody_settles_within_less_than_2_14_ms_at_400_vpp() {
    // −τ ln(1 − 0.95 · 2/(K1 · 400)) = 2.145 ms
    let floor = -1.88 * (1.0 - 1.9 / (0.006_98 * 400.0_f64)).ln();
    assert!((floor - 2.145).abs() < 1e-3, "{floor}");
    for (at_most, late, expected) in [
        (floor + 1e-5, 3.0, FAIL),
        (floor - 1e-5, 3.0, inconclusive(Cause::Infeasible)),
        (floor + 1e-2, 0.0, PASS),
        (2.0, 0.0, inconclusive(Cause::Infeasible)),
    ] {
        let expect = format!("metric = \"settling_time_ms\", at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 400.0, ..BASE }.scenario();
        let rows = trace_rows(&scenario, |t| fastest_envelope(400.0)((t - late).max(0.0)));
        assert_eq!(judge_rows(&scenario, &set_saturated(rows.clone())), expected, "{at_most} ms");
        assert_eq!(
            judge_rows(&scenario, &rows),
            if expected == PASS { PASS } else { FAIL },
            "{at_most} ms, never saturated"
        );
    }
}

#[test]
fn a_later_step_has_its_own_floor() {
    let setpoint = "{ hold = [[0.0, 1.0], [30.0, 2.0]] }";
    // From 1 µm: −τ ln((S − 1.9)/(S − 1)), S = 2.792 µm.
    let floor = -1.88 * ((2.792_f64 - 1.9) / (2.792 - 1.0)).ln();
    for (at_most, expected) in [(floor + 1e-5, FAIL), (floor - 1e-5, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"settling_time_ms\", from_ms = 30.0, at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 400.0, setpoint, ..BASE }.scenario();
        let rows = trace_rows(&scenario, |t| if t < 40.0 { 1.0 } else { 2.0 });
        assert_eq!(judge_rows(&scenario, &set_saturated(rows)), expected, "{at_most} ms");
    }
}

#[test]
fn a_plate_falls_no_faster_than_it_forgets() {
    let setpoint = "{ hold = [[0.0, 2.0], [30.0, 1.0]] }";
    let floor = 1.88 * (2.0_f64 / 1.05).ln();
    for (at_most, expected) in [(floor + 1e-5, FAIL), (floor - 1e-5, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"settling_time_ms\", from_ms = 30.0, at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], setpoint, ..BASE }.scenario();
        let driven = trace_rows(&scenario, |t| if t < 35.0 { 2.0 } else { 1.0 });
        assert_eq!(judge_rows(&scenario, &driven), FAIL, "it was driven on: nobody but the controller");
        let mut rested = driven.clone();
        for row in rested.iter_mut().filter(|row| row.t_s >= 0.03) {
            row.drive_vpp = 0.0;
        }
        assert_eq!(judge_rows(&scenario, &rested), expected, "{at_most} ms");
    }
}

#[test]
fn an_excuse_is_for_too_little_amplitude_only() {
    let build = |expect: &str| ScenarioBuilder { expect: &[expect], limit_vpp: 400.0, force: "2.0", ..BASE }.scenario();
    for expect in [
        "metric = \"overshoot_percent\", at_most = 1.0",
        "metric = \"frequency_error_hz\", at_most = 1.0",
        "metric = \"drive_peak_vpp\", at_most = 1.0",
        "metric = \"saturated_percent\", at_most = 0.01",
        "metric = \"final_amplitude_um\", at_most = 1.1",
    ] {
        let scenario = build(expect);
        let mut rows = set_saturated(trace_rows(&scenario, |t| if t < 30.0 { 2.5 } else { 1.19 }));
        rows.last_mut().unwrap().frequency_hz = 9.0;
        assert_eq!(judge_rows(&scenario, &rows), FAIL, "{expect}");
    }
    for expect in [
        "metric = \"final_amplitude_um\", at_least = 1.9",
        "metric = \"peak_deviation_percent\", at_most = 10.0, from_ms = 30.0",
        "metric = \"recovery_time_ms\", at_most = 10.0, from_ms = 30.0",
        "metric = \"settling_time_ms\", at_most = 10.0",
    ] {
        let scenario = build(expect);
        assert_eq!(
            judge_rows(&scenario, &set_saturated(trace_rows(&scenario, |_| 1.19))),
            inconclusive(Cause::Infeasible),
            "{expect}"
        );
    }
}

#[test]
fn an_excused_trial_does_not_excuse_another() {
    let each = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 2);
    let excused = |values: &[f64], which: &[usize]| {
        let mut trials = trials_with_values(values);
        for index in which {
            trials[*index].excuses = vec![Some(TOO_WEAK)];
        }
        trials
    };
    assert_eq!(verdict_and_cause(&each, &excused(&[9.0, 1.0], &[0])), inconclusive(Cause::Infeasible));
    assert_eq!(
        verdict_and_cause(&each, &excused(&[9.0, 3.0], &[0])),
        FAIL,
        "the worst is excused, the other one is not"
    );
    assert_eq!(verdict_and_cause(&each, &excused(&[1.0, 1.0], &[0])), PASS);
    let mean = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 4);
    assert_eq!(verdict_and_cause(&mean, &excused(&[9.0, 9.1, 9.2, 9.3], &[0])), FAIL);
    assert_eq!(
        verdict_and_cause(&mean, &excused(&[9.0, 9.1, 9.2, 9.3], &[0, 1, 2, 3])),
        inconclusive(Cause::Infeasible)
    );
    assert_eq!(verdict_and_cause(&mean, &excused(&[9.0, 9.1, 0.1, 0.2], &[0, 1])), inconclusive(Cause::Evidence));
}

#[test]
fn a_better_drive_excuses_nothing_but_chance_draws_the_plates() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 2);
    let rows = set_saturated(trace_rows(&scenario, |_| 1.5));
    let trials: Vec<_> = (0..2).map(|index| measure(&scenario, index, &rows, &Telemetry::default())).collect();
    assert_eq!(trials.iter().map(|trial| trial.seed).collect::<Vec<_>>(), [1, 2]);
    assert!(trials.iter().all(|trial| trial.excuses == [None]));
}

#[test]
fn metrics_are_recorded_by_name_with_a_number_from_the_second_on() {
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
    let record = trial_record(&scenario, &trial_measures(0, &measures), "traces/s/000.csv".to_owned(), None);
    let text = serde_json::to_string(&record.metrics).unwrap();
    assert_eq!(
        text,
        r#"{"settling_time_ms":1.93,"static_error_percent":0.5,"settling_time_ms[2]":null,"settling_time_ms[3]":4.0}"#
    );
}

/// How often a verdict is a pass, where the truth lies exactly on the limit.
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
fn a_controller_on_the_limit_passes_in_one_run_of_twenty() {
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

#[rstest]
#[case("metric = \"settling_time_ms\", at_most = 2.0", (None, Some(5.0), Some("amplitude_um")))]
#[case("metric = \"settling_time_ms\", at_most = 2.0, from_ms = 20.0, band_percent = 1.0, signal = \"wd_um\"", (Some(20.0), Some(1.0), Some("wd_um")))]
#[case("metric = \"overshoot_percent\", at_most = 2.0, from_ms = 3.0", (Some(3.0), None, Some("amplitude_um")))]
#[case("metric = \"drive_peak_vpp\", at_most = 900.0", (None, None, None))]
fn what_a_metric_was_measured_by_is_recorded(
    #[case] expect: &str,
    #[case] expected: (Option<f64>, Option<f64>, Option<&str>),
) {
    let scenario = ScenarioBuilder { expect: &[expect], ..BASE }.scenario();
    let found = judge_single_expectation(&scenario, &trials_with_values(&[1.0])).definition;
    assert_eq!((found.from_ms, found.band_percent, found.signal.as_deref()), expected);
}
