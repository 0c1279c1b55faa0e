use super::*;
use crate::metrics::Measure;
use crate::statistics::SampleSummary;
use crate::trial::{measure, trial_record};
use platebench_model::record::{
    BestResponse, Divergence, Exclusion, Excuse, MissingValue, Reason, Statistic, Telemetry, TrialReason,
    UndefinedValue, Violation, ViolationKind,
};
use platebench_model::scenario::Metric;
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;
use platebench_test_kit::{PLATE, parse_scenario};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rstest::rstest;

mod each_trial;
mod exclusion;
mod feasibility;
mod mean_and_deviation;
mod over_trials;
mod record;
mod sequential;
mod trial_difference;

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
        let limit = "limit_vpp = 900.0";
        assert!(PLATE.contains(limit));
        let plate = PLATE.replace(limit, &format!("limit_vpp = {:?}", self.limit_vpp));
        let spread = if self.is_varied { "[trials.spread]\nsensor_gain_percent = 1.2\n" } else { "" };
        let text = format!(
            "title = \"Synthetic\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n\
             expect = [{}]\n[profile]\nsetpoint_um = {}\n\
             finger_force_n = {}\n[trials]\ncount = {}\nmax_count = {}\n{spread}",
            self.expect.iter().map(|expect| format!("{{ {expect} }}")).collect::<Vec<_>>().join(", "),
            self.setpoint,
            self.force,
            self.trials,
            self.max_count.max(self.trials)
        );
        parse_scenario(&text, &plate)
    }
}

/// Scenario of one deterministic trial.
fn fixed_scenario(expect: &str) -> Scenario {
    ScenarioBuilder { expect: &[expect], ..BASE }.scenario()
}

fn varied_scenario(expect: &str, trials: u32) -> Scenario {
    ScenarioBuilder { expect: &[expect], trials, is_varied: true, ..BASE }.scenario()
}

fn trial_measures(index: u32, measures: &[Measure]) -> TrialMeasures {
    TrialMeasures {
        ended: None,
        stopped: None,
        violations: Vec::new(),
        index,
        seed: u64::from(index) + 1,
        measures: measures.to_vec(),
        worst: vec![None; measures.len()],
        excuses: vec![None; measures.len()],
        divergence: None,
        symptom: None,
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

fn judge_values(scenario: &Scenario, values: &[f64]) -> ExpectationRecord {
    judge_single_expectation(scenario, &trials_with_values(values))
}

fn decide(scenario: &Scenario, values: &[f64]) -> (Verdict, Option<Cause>) {
    verdict_and_cause(scenario, &trials_with_values(values))
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

#[rstest]
#[case::simulated(false, true)]
#[case::real_plate(true, false)]
fn a_simulated_value_has_the_bench_error(#[case] is_real_plate: bool, #[case] expected: bool) {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let trials = [TrialMeasures { is_real_plate, ..trial_measures(0, &[Measure::Value(1.9)]) }];
    let judgement = judge(&scenario, &trials);
    let stated = judgement.clone().with_bench_errors(&scenario);
    let error = stated.expectations[0].bench_error;
    assert_eq!(error.is_some_and(|error| error > 0.0 && error < 1e-3), expected, "{error:?}");
    assert_eq!((stated.verdict, stated.expectations[0].margin), (judgement.verdict, judgement.expectations[0].margin));
}

#[test]
fn a_missing_value_has_no_bench_error() {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let trials = [trial_measures(0, &[Measure::Missing(MissingValue::NeverSettles)])];
    assert_eq!(judge(&scenario, &trials).with_bench_errors(&scenario).expectations[0].bench_error, None);
}

fn values_with_moments(count: usize, mean: f64, deviation: f64) -> Vec<f64> {
    let raw: Vec<f64> = (0..count).map(|index| index as f64).collect();
    let summary = SampleSummary::of(&raw).unwrap();
    raw.iter().map(|value| mean + (value - summary.mean) / summary.deviation * deviation).collect()
}

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

fn judge_rows(scenario: &Scenario, rows: &[Row]) -> (Verdict, Option<Cause>) {
    verdict_and_cause(scenario, &[measure(scenario, 0, rows, &Telemetry::default())])
}
