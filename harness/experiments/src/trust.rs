//! Measures the bench's own errors: the kill rate over mutants and the false-alarm rate over
//! correct controllers. An expectation on one of a mutant's metrics catches the mutant if the
//! mutant fails it and the reference controller passes it. An inconclusive verdict catches nothing.
//! See `docs/trust.md`.

pub mod catalogue;
pub mod mutant_controller;
mod mutants;
pub mod play;
mod protocol_faults;
mod protocol_mutants;
pub mod report;
mod watchdog_mutants;

use platebench_engine::workers::collect_in_parallel;
use platebench_model::record::{Verdict, ViolationKind};
use platebench_model::scenario::{Metric, Scenario, Spread};
use platebench_rig::BoxedLink;
use play::play_as;
use report::{
    CONFIDENCE, FailedExpectation, FalseAlarm, FalseAlarmResult, MutantOutcome, MutantResult, ProtocolFaultResult,
    Rate, ScenarioRate,
};

pub use catalogue::{CleanVariant, MutantSpec, ReferenceController, catalogue, clean_variants};
pub use mutant_controller::{Mutant, MutantController};
pub use play::{PlayResult, TrustError, play};
pub use protocol_faults::protocol_faults;
pub use report::TrustReport;

/// Standard deviations of the plate in clean runs. They replace zeros of the scenario.
const GAIN_PERCENT: f64 = 0.3;
const TIME_CONSTANT_PERCENT: f64 = 0.3;
const TEMPERATURE_K: f64 = 0.05;
/// Difference between the seeds of two clean runs, larger than the number of trials of a run.
const SEEDS_PER_RUN: u64 = 100_000;
/// Clean runs skip longer scenarios: one of a minute takes as long as a thousand short ones.
const MAX_CLEAN_DURATION_S: f64 = 10.0;

#[derive(Debug, Clone)]
pub struct TrustConfig {
    pub scenarios: Vec<Scenario>,
    pub mutants: Vec<MutantSpec>,
    /// Faults with a kill rate of their own, which does not change the verdict.
    pub protocol_faults: Vec<MutantSpec>,
    pub variants: Vec<CleanVariant>,
    pub clean_runs: u32,
    pub seed: u64,
    pub jobs: usize,
}

pub fn measure(config: &TrustConfig) -> Result<TrustReport, TrustError> {
    let (suite, faults) = (&config.scenarios, &config.mutants);
    let references =
        run_suite(config.jobs, suite, &ReferenceController::ALL, |_| "reference", |reference| reference.link())?;
    let of_reference =
        |reference: ReferenceController| references.get(reference as usize).map_or(&[][..], Vec::as_slice);
    let judge = |faults: &[MutantSpec]| -> Result<Vec<MutantResult>, TrustError> {
        let played = run_suite(config.jobs, suite, faults, |entry| entry.name, MutantSpec::link)?;
        let results = faults.iter().zip(&played);
        Ok(results.map(|(entry, judged)| mutant_result(entry, suite, judged, of_reference(entry.reference))).collect())
    };
    let outcomes = judge(faults)?;
    let protocol_outcomes = judge(&config.protocol_faults)?;
    let mut alarms = suite_alarms("reference", suite, of_reference(ReferenceController::Firmware));
    let by_firmware: Vec<FailedExpectation> = alarms.iter().map(|alarm| alarm.cell.clone()).collect();
    let variants = run_suite(config.jobs, suite, &config.variants, |variant| variant.name, CleanVariant::link)?;
    for (variant, judged) in config.variants.iter().zip(&variants) {
        let own = suite_alarms(variant.name, suite, judged).into_iter();
        alarms.extend(own.filter(|alarm| !by_firmware.contains(&alarm.cell)));
    }
    let clean = measure_false_alarms(config, alarms)?;
    let kill_rate = kill_rate_of(&outcomes);
    let passes = kill_rate.seen == kill_rate.count && !faults.is_empty() && clean.alarms.is_empty();
    Ok(TrustReport {
        format: 1,
        verdict: if passes { Verdict::Pass } else { Verdict::Fail },
        confidence: CONFIDENCE,
        kill_rate,
        scenarios: suite.iter().map(|scenario| scenario_rate(scenario, &outcomes)).collect(),
        faults: outcomes,
        protocol_faults: ProtocolFaultResult { kill_rate: kill_rate_of(&protocol_outcomes), faults: protocol_outcomes },
        clean,
    })
}

fn kill_rate_of(outcomes: &[MutantResult]) -> Rate {
    Rate::new(outcomes.iter().filter(|fault| fault.outcome == MutantOutcome::Caught).count(), outcomes.len())
}

fn suite_alarms(controller: &str, suite: &[Scenario], results: &[PlayResult]) -> Vec<FalseAlarm> {
    let alarms = suite.iter().zip(results).flat_map(|(scenario, result)| {
        let alarm =
            move |cell| FalseAlarm { controller: controller.to_owned(), run: None, seed: scenario.trials.seed, cell };
        failures(scenario, result).map(move |(_, cell)| alarm(cell))
    });
    alarms.collect()
}

fn scenario_rate(scenario: &Scenario, outcomes: &[MutantResult]) -> ScenarioRate {
    let caught = outcomes.iter().filter(|fault| fault.is_caught_by(&scenario.file)).count();
    ScenarioRate { file: scenario.file.clone(), kill_rate: Rate::new(caught, outcomes.len()) }
}

fn mutant_result(
    entry: &MutantSpec,
    suite: &[Scenario],
    judged: &[PlayResult],
    without: &[PlayResult],
) -> MutantResult {
    let mut right = Vec::new();
    let mut wrong = Vec::new();
    for ((scenario, judged), without) in suite.iter().zip(judged).zip(without) {
        let by_reference: Vec<_> = failures(scenario, without).map(|(_, cell)| cell).collect();
        for (reason, cell) in failures(scenario, judged).filter(|(_, cell)| !by_reference.contains(cell)) {
            let is_right = match reason {
                FailedBy::Metric(Metric::ReferenceDifference | Metric::ProtocolDifferences) => true,
                FailedBy::Metric(metric) => entry.detecting_metrics.contains(&metric),
                FailedBy::Violation(kind) => entry.detecting_violations.contains(&kind),
            };
            if is_right { right.push(cell) } else { wrong.push(cell) }
        }
    }
    let outcome = match (right.is_empty(), wrong.is_empty()) {
        (false, _) => MutantOutcome::Caught,
        (true, false) => MutantOutcome::WrongReason,
        (true, true) => MutantOutcome::Survived,
    };
    MutantResult {
        name: entry.name.to_owned(),
        mistake: entry.description.to_owned(),
        should_be_caught_by: entry.detecting_metrics.iter().map(ToString::to_string).collect(),
        outcome,
        right,
        wrong,
    }
}

enum FailedBy {
    Metric(Metric),
    Violation(ViolationKind),
}

/// Returns the expectations with verdict `fail` and the violations of the protocol.
fn failures<'a>(
    scenario: &'a Scenario,
    result: &'a PlayResult,
) -> impl Iterator<Item = (FailedBy, FailedExpectation)> + 'a {
    let cell = |expectation, metric| FailedExpectation { scenario: scenario.file.clone(), expectation, metric };
    let both = scenario.expectations.iter().zip(&result.judgement.expectations).zip(1..);
    let failed = both.filter(|((_, record), _)| record.verdict == Verdict::Fail);
    let by_metric = failed.map(move |((expectation, _), number)| {
        (FailedBy::Metric(expectation.metric), cell(number, expectation.metric.to_string()))
    });
    let violation = move |&kind: &ViolationKind| (FailedBy::Violation(kind), cell(0, format!("violation {kind:?}")));
    by_metric.chain(result.violations.iter().map(violation))
}

fn measure_false_alarms(config: &TrustConfig, mut alarms: Vec<FalseAlarm>) -> Result<FalseAlarmResult, TrustError> {
    let varied: Vec<(&Scenario, Scenario)> =
        config.scenarios.iter().filter_map(|scenario| Some((scenario, with_plate_spread(scenario)?))).collect();
    let runs: Vec<u32> = if varied.is_empty() { Vec::new() } else { (0..config.clean_runs).collect() };
    let judged = collect_in_parallel(config.jobs, &runs, |&run| {
        let Some(scenario) = varied.get(run as usize % varied.len().max(1)) else { return Err(TrustError::Internal) };
        let (scenario, varied) = scenario;
        let mut scene = varied.clone();
        scene.trials.seed = config.seed.wrapping_add(u64::from(run).wrapping_mul(SEEDS_PER_RUN));
        let judged = play_as(scenario, &scene, "reference", &|| ReferenceController::Firmware.link())?;
        let cells: Vec<FailedExpectation> = failures(scenario, &judged).map(|(_, cell)| cell).collect();
        Ok((scene.trials.seed, judged.judgement.verdict, cells))
    })?;
    let count = |wanted| judged.iter().filter(|(_, verdict, _)| *verdict == wanted).count();
    for (run, (seed, _, cells)) in (0..).zip(&judged) {
        alarms.extend(cells.iter().map(|cell| FalseAlarm {
            controller: "reference".to_owned(),
            run: Some(run),
            seed: *seed,
            cell: cell.clone(),
        }));
    }
    Ok(FalseAlarmResult {
        false_alarm_rate: Rate::new(count(Verdict::Fail), judged.len()),
        inconclusive: count(Verdict::Inconclusive) as u32,
        scenarios: varied.len() as u32,
        seed: config.seed,
        alarms,
    })
}

/// Returns the scenario with a plate that varies between trials. `None` if the scenario is too long
/// or open-loop, because an open-loop scenario judges the plate and not the controller.
fn with_plate_spread(scenario: &Scenario) -> Option<Scenario> {
    if scenario.controller.law == "open-loop" || scenario.duration.seconds() > MAX_CLEAN_DURATION_S {
        return None;
    }
    let mut varied = scenario.clone();
    let own = |given: f64, ours: f64| if given == 0.0 { ours } else { given };
    let spread = scenario.trials.spread;
    varied.trials.spread = Spread {
        gain_percent: own(spread.gain_percent, GAIN_PERCENT),
        time_constant_percent: own(spread.time_constant_percent, TIME_CONSTANT_PERCENT),
        temperature_k: own(spread.temperature_k, TEMPERATURE_K),
        ..spread
    };
    Some(varied)
}

/// Returns one row of results per controller. The results of a row have the order of `suite`.
fn run_suite<T: Sync>(
    jobs: usize,
    suite: &[Scenario],
    controllers: &[T],
    name: impl Fn(&T) -> &'static str + Sync,
    link: impl Fn(&T) -> BoxedLink + Send + Sync,
) -> Result<Vec<Vec<PlayResult>>, TrustError> {
    if suite.is_empty() {
        return Ok(controllers.iter().map(|_| Vec::new()).collect());
    }
    let pairs: Vec<(&T, &Scenario)> =
        controllers.iter().flat_map(|controller| suite.iter().map(move |scenario| (controller, scenario))).collect();
    let judged = collect_in_parallel(jobs, &pairs, |(controller, scenario)| {
        play(scenario, name(controller), &|| link(controller))
    })?;
    Ok(judged.chunks(suite.len()).map(<[PlayResult]>::to_vec).collect())
}
