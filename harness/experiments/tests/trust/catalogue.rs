//! Checks that the witness scenario catches each mutant and does not fail a correct controller.

use platebench_engine::{Executor, ExecutorSettings, SafeEnds};
use platebench_experiments::trust::report::MutantOutcome;
use platebench_experiments::trust::{
    Mutant, MutantSpec, TrustConfig, TrustReport, catalogue, measure, protocol_faults,
};
use platebench_model::record::Verdict;
use platebench_model::scenario::Metric;
use platebench_rig::CancelToken;
use platebench_test_kit::{load_scenario, workspace_root};
use platebench_verdict::measure as measure_trial;
use rstest::rstest;
use std::collections::BTreeSet;
use std::fs;

fn empty_config() -> TrustConfig {
    let (mutants, protocol_faults, variants) = (Vec::new(), Vec::new(), Vec::new());
    TrustConfig { scenarios: Vec::new(), mutants, protocol_faults, variants, clean_runs: 0, seed: 1, jobs: 2 }
}

fn measure_suite(scenarios: &[&str], faults: Vec<MutantSpec>, clean: u32) -> TrustReport {
    let scenarios = scenarios.iter().map(|name| load_scenario(name)).collect();
    measure(&TrustConfig { scenarios, mutants: faults, clean_runs: clean, ..empty_config() }).unwrap()
}

#[test]
fn has_enough_mutants_with_unique_names() {
    let names: BTreeSet<_> = catalogue().iter().map(|entry| entry.name).collect();
    assert_eq!(names.len(), catalogue().len());
    assert!(names.len() >= 24);
}

#[test]
fn every_mutant_is_caught_by_its_witness_scenario() {
    let missed: Vec<_> = catalogue()
        .into_iter()
        .filter(|entry| {
            measure_suite(&[entry.witness_scenario], vec![*entry], 0).faults[0].outcome != MutantOutcome::Caught
        })
        .map(|entry| entry.name)
        .collect();
    assert!(missed.is_empty(), "{missed:?}");
}

#[test]
fn the_suite_catches_at_least_25_of_40_protocol_faults() {
    let faults = protocol_faults();
    let scenarios: BTreeSet<_> =
        faults.iter().map(|fault| fault.witness_scenario).filter(|name| !name.is_empty()).collect();
    let scenarios = scenarios.into_iter().map(load_scenario).collect();
    let config = TrustConfig { scenarios, protocol_faults: faults.clone(), ..empty_config() };
    let result = measure(&config).unwrap().protocol_faults;
    let missed: Vec<_> = (faults.iter().zip(&result.faults))
        .filter(|(fault, result)| !fault.witness_scenario.is_empty() && !result.is_caught_by(fault.witness_scenario))
        .map(|(fault, _)| fault.name)
        .collect();
    assert!(missed.is_empty(), "{missed:?}");
    assert!(result.kill_rate.seen >= 25 && result.kill_rate.count == 40, "{:?}", result.kill_rate);
}

/// The console names these causes, so that a user finds the mistake without a look at the trace.
#[rstest]
#[case::wind_up("no-anti-windup", "paper/setpoint-steps.toml", "anti-windup")]
#[case::doubled_gain("drive-gain-doubled", "paper/fig13-closed-loop.toml", "2.000 times Kp and 2.000 times Ki")]
#[case::halved_gain("drive-gain-halved", "paper/fig13-closed-loop.toml", "0.500 times Kp and 0.500 times Ki")]
#[case::no_integral("integral-missing", "paper/fig13-closed-loop.toml", "no integral")]
#[case::frequency_sign("frequency-sign", "paper/fig15-frequency.toml", "sign of the frequency loop")]
#[case::correct("setpoint-scale", "paper/fig13-closed-loop.toml", "")]
fn a_mutant_has_a_likely_cause(#[case] mutant: &str, #[case] file: &str, #[case] cause: &str) {
    let mutant = catalogue().into_iter().find(|entry| entry.name == mutant).unwrap();
    let mut scenario = load_scenario(file);
    // The gains of `dq-pi` adapt, so they cannot be fitted.
    scenario.controller.law = "dq-pi-fixed".to_owned();
    let (connect, ends) = (|| Ok(mutant.link()), SafeEnds::default());
    let mut executor = Executor::new(&connect, ExecutorSettings::lockstep(&CancelToken::never()), &ends);
    let law = platebench_engine::law(&scenario).unwrap();
    let played = executor.play(&scenario, law, 0, None).unwrap().unwrap();
    let symptom = measure_trial(&scenario, 0, &played.trace_rows, &played.telemetry).symptom;
    let text = symptom.map(|symptom| symptom.to_string()).unwrap_or_default();
    assert!(text.contains(cause) && text.is_empty() == cause.is_empty(), "{text}");
}

struct Unmutated;

impl Mutant for Unmutated {}

#[test]
fn an_unmutated_controller_survives_and_fails_the_suite() {
    let scenarios = ["paper/fig13-closed-loop.toml", "faults/doubled-messages.toml", "faults/flipped-bit.toml"];
    let unmutated = MutantSpec { build: || Box::new(Unmutated), ..catalogue()[0] };
    let report = measure_suite(&scenarios, vec![MutantSpec { detecting_metrics: Metric::ALL, ..unmutated }], 0);
    assert_eq!(report.faults[0].outcome, MutantOutcome::Survived, "{:?}", report.faults[0]);
    assert_eq!((report.kill_rate.seen, report.kill_rate.count, report.verdict), (0, 1, Verdict::Fail));
}

#[test]
fn another_metric_than_the_expected_does_not_count() {
    let fault = catalogue().into_iter().find(|entry| entry.name == "setpoint-scale").unwrap();
    let fault = MutantSpec { detecting_metrics: &[Metric::ShutdownTime], ..fault };
    let report = measure_suite(&["paper/fig13-closed-loop.toml"], vec![fault], 0);
    assert_eq!(report.faults[0].outcome, MutantOutcome::WrongReason);
    assert_eq!((report.kill_rate.seen, report.verdict), (0, Verdict::Fail));
}

#[test]
fn failures_of_the_reference_catch_no_mutant() {
    // The reference also settles too late under 2 N: its gains are for the untouched plate.
    let fault = catalogue().into_iter().find(|entry| entry.name == "no-anti-windup").unwrap();
    let report = measure_suite(&["paper/fig16-closed-loop.toml"], vec![fault], 0);
    assert_eq!(report.faults[0].outcome, MutantOutcome::Survived, "{:?}", report.faults[0]);
}

#[test]
fn a_failed_clean_run_is_a_false_alarm() {
    let mut strict = load_scenario("paper/fig13-closed-loop.toml");
    // With the nominal plate, an error of 4.2 % of the step and a ripple remain after two periods.
    // With a band of 4.5 %, some of the varied plates therefore fail.
    strict.expectations[0].band_percent = 4.5;
    let faults = catalogue().into_iter().filter(|entry| entry.name == "setpoint-scale").collect::<Vec<_>>();
    let order = |scenario| TrustConfig {
        scenarios: vec![scenario],
        mutants: faults.clone(),
        protocol_faults: Vec::new(),
        variants: Vec::new(),
        clean_runs: 20,
        seed: 1,
        jobs: 2,
    };
    let report = measure(&order(strict)).unwrap();
    let rate = report.clean.false_alarm_rate;
    assert!(rate.seen > 0 && rate.seen < 20, "{rate:?}");
    assert_eq!((report.clean.alarms.len(), report.verdict), (rate.seen as usize, Verdict::Fail));
    let report = measure(&order(load_scenario("paper/fig13-closed-loop.toml"))).unwrap();
    assert_eq!((report.clean.false_alarm_rate.seen, report.verdict), (0, Verdict::Pass));
}

#[test]
fn documented_matrix_equals_a_rerun() {
    let page = fs::read_to_string(workspace_root().join("docs/trust.md")).unwrap();
    let file = "faults/five-periods-of-silence.toml";
    let report = measure_suite(&[file], catalogue(), 0);
    let mut names: Vec<_> =
        report.faults.iter().filter(|fault| !fault.right.is_empty()).map(|fault| fault.name.as_str()).collect();
    names.sort_unstable();
    let row = format!("| {file} | {} of {} | {} |", names.len(), catalogue().len(), names.join(", "));
    assert!(page.contains(&row), "not in docs/trust.md: {row}");
    for entry in catalogue() {
        assert!(page.contains(&format!("| {} | {} |", entry.name, entry.description)), "{}", entry.name);
    }
    assert!(page.contains(&format!("| {0} of {0} |", catalogue().len())));
}

#[test]
fn inconclusive_catches_no_mutant_and_is_no_false_alarm() {
    let mut doubtful = load_scenario("paper/fig13-closed-loop.toml");
    // One trial cannot decide the mean of a plate that varies.
    doubtful.trials.spread.gain_percent = 0.3;
    doubtful.expectations.retain(|expectation| expectation.metric == Metric::StaticError);
    let faults = catalogue().into_iter().filter(|entry| entry.name == "setpoint-scale").collect();
    let report = measure(&TrustConfig {
        scenarios: vec![doubtful],
        mutants: faults,
        protocol_faults: Vec::new(),
        variants: Vec::new(),
        clean_runs: 3,
        seed: 1,
        jobs: 1,
    })
    .unwrap();
    assert_eq!(report.faults[0].outcome, MutantOutcome::Survived);
    assert_eq!((report.clean.inconclusive, report.clean.false_alarm_rate.seen), (3, 0));
    assert!(report.clean.alarms.is_empty(), "{:?}", report.clean.alarms);
}
