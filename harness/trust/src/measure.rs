//! Kill rate over the catalogue, false alarms over clean runs.

use crate::catalogue::{Entry, Reference};
use crate::play::{TrustError, play, play_as};
use crate::report::{Alarm, CONFIDENCE, Cell, Clean, FaultOutcome, Outcome, Rate, Report, ScenarioRate};
use platebench_rig::AnyLink;
use platebench_scenario::{Metric, Scenario, Spread};
use platebench_verdict::{Judgement, Verdict};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use tracing::subscriber::{NoSubscriber, with_default};

/// Clean runs of a plate that is never quite the nominal one: standard deviations where the scenario has none of its own.
const GAIN_PERCENT: f64 = 0.3;
const TIME_CONSTANT_PERCENT: f64 = 0.3;
const TEMPERATURE_K: f64 = 0.05;
/// Seeds of one run's trials do not meet those of the next.
const SEEDS_PER_RUN: u64 = 100_000;
/// A scenario that lasts longer than this takes no part in clean runs: a minute of plate time costs as much as a thousand others.
const LONGEST_CLEAN_S: f64 = 2.0;

/// What is to be measured.
#[derive(Debug, Clone)]
pub struct Order {
    /// The suite.
    pub scenarios: Vec<Scenario>,
    /// The faults.
    pub faults: Vec<Entry>,
    /// Clean runs.
    pub clean: u32,
    /// Seed of the first of them.
    pub seed: u64,
    /// Workers.
    pub jobs: usize,
}

/// Measures the suite's error rates.
///
/// # Errors
/// [`TrustError`] where a controller cannot be played to at all.
pub fn measure(order: &Order) -> Result<Report, TrustError> {
    let (suite, faults) = (&order.scenarios, &order.faults);
    let references = on_suite(order.jobs, suite, &Reference::ALL, |reference| ("reference", reference.link()))?;
    let failed_without = |reference: Reference| {
        Reference::ALL.iter().position(|other| *other == reference).and_then(|row| references.get(row))
    };
    let played = on_suite(order.jobs, suite, faults, |entry| (entry.name, entry.link()))?;
    let outcomes: Vec<FaultOutcome> = faults
        .iter()
        .zip(&played)
        .map(|(entry, judged)| {
            outcome(entry, suite, judged, failed_without(entry.reference).map_or(&[], Vec::as_slice))
        })
        .collect();
    let mut alarms: Vec<Alarm> = failed_without(Reference::Firmware)
        .into_iter()
        .flat_map(|judged| suite.iter().zip(judged))
        .flat_map(|(scenario, judged)| failed(scenario, judged).map(|cell| (scenario.trials.seed, cell)))
        .map(|(seed, (_, cell))| Alarm { run: None, seed, cell })
        .collect();
    let clean = clean(order, &mut alarms)?;
    let caught = outcomes.iter().filter(|fault| fault.outcome == Outcome::Caught).count();
    let passes = caught == faults.len() && !faults.is_empty() && alarms.is_empty();
    Ok(Report {
        format: 1,
        verdict: if passes { Verdict::Pass } else { Verdict::Fail },
        confidence: CONFIDENCE,
        kill_rate: Rate::of(caught, faults.len()),
        scenarios: suite.iter().map(|scenario| scenario_rate(scenario, &outcomes)).collect(),
        faults: outcomes,
        clean: Clean { alarms, ..clean },
    })
}

fn scenario_rate(scenario: &Scenario, outcomes: &[FaultOutcome]) -> ScenarioRate {
    let catches = |fault: &&FaultOutcome| fault.right.iter().any(|cell| cell.scenario == scenario.file);
    ScenarioRate {
        file: scenario.file.clone(),
        kill_rate: Rate::of(outcomes.iter().filter(catches).count(), outcomes.len()),
    }
}

/// What became of a fault, from its judgements and those of the same controller without the mistake.
fn outcome(entry: &Entry, suite: &[Scenario], judged: &[Judgement], without: &[Judgement]) -> FaultOutcome {
    let mut right = Vec::new();
    let mut wrong = Vec::new();
    for ((scenario, judged), without) in suite.iter().zip(judged).zip(without) {
        let innocent: Vec<Cell> = failed(scenario, without).map(|(_, cell)| cell).collect();
        for (metric, cell) in failed(scenario, judged).filter(|(_, cell)| !innocent.contains(cell)) {
            if entry.metrics.contains(&metric) { right.push(cell) } else { wrong.push(cell) }
        }
    }
    let outcome = match (right.is_empty(), wrong.is_empty()) {
        (false, _) => Outcome::Caught,
        (true, false) => Outcome::WrongReason,
        (true, true) => Outcome::Survived,
    };
    FaultOutcome {
        name: entry.name.to_owned(),
        mistake: entry.mistake.to_owned(),
        should_be_caught_by: entry.metrics.iter().map(ToString::to_string).collect(),
        outcome,
        right,
        wrong,
    }
}

/// Expectations that failed; a doubt is no failure.
fn failed<'a>(scenario: &'a Scenario, judged: &'a Judgement) -> impl Iterator<Item = (Metric, Cell)> + 'a {
    let both = scenario.expectations.iter().zip(&judged.expectations).zip(1..);
    both.filter(|((_, record), _)| record.verdict == Verdict::Fail).map(|((expectation, _), number)| {
        let metric = expectation.metric;
        let cell = Cell { scenario: scenario.file.clone(), expectation: number, metric: metric.to_string() };
        (metric, cell)
    })
}

fn clean(order: &Order, alarms: &mut Vec<Alarm>) -> Result<Clean, TrustError> {
    let varied: Vec<(&Scenario, Scenario)> =
        order.scenarios.iter().filter_map(|scenario| Some((scenario, varied(scenario)?))).collect();
    let runs: Vec<u32> = if varied.is_empty() { Vec::new() } else { (0..order.clean).collect() };
    let judged = in_parallel(order.jobs, &runs, |&run| {
        let Some(scenario) = varied.get(run as usize % varied.len().max(1)) else { return Err(TrustError::Bench) };
        let (scenario, varied) = scenario;
        let mut scene = varied.clone();
        scene.trials.seed = order.seed.wrapping_add(u64::from(run).wrapping_mul(SEEDS_PER_RUN));
        let judged = play_as(scenario, &scene, "reference", Reference::Firmware.link())?;
        let cells: Vec<Cell> = failed(scenario, &judged).map(|(_, cell)| cell).collect();
        Ok((scene.trials.seed, judged.verdict, cells))
    })?;
    let count = |wanted| judged.iter().filter(|(_, verdict, _)| *verdict == wanted).count();
    for (run, (seed, _, cells)) in (0..).zip(&judged) {
        alarms.extend(cells.iter().map(|cell| Alarm { run: Some(run), seed: *seed, cell: cell.clone() }));
    }
    Ok(Clean {
        false_alarm_rate: Rate::of(count(Verdict::Fail), judged.len()),
        inconclusive: count(Verdict::Inconclusive) as u32,
        scenarios: varied.len() as u32,
        seed: order.seed,
        alarms: Vec::new(),
    })
}

/// The scenario with a plate that differs from trial to trial; `None` where it takes no part in clean runs: the open loop is as exact as the plate that it was
/// told of, so that its scenarios judge the plate and no controller.
fn varied(scenario: &Scenario) -> Option<Scenario> {
    if scenario.controller.law == "open-loop" || scenario.duration.seconds() > LONGEST_CLEAN_S {
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

/// Plays every scenario to every controller; a row per controller.
fn on_suite<T: Sync>(
    jobs: usize,
    suite: &[Scenario],
    controllers: &[T],
    link: impl Fn(&T) -> (&'static str, AnyLink) + Sync,
) -> Result<Vec<Vec<Judgement>>, TrustError> {
    if suite.is_empty() {
        return Ok(controllers.iter().map(|_| Vec::new()).collect());
    }
    let pairs: Vec<(&T, &Scenario)> =
        controllers.iter().flat_map(|controller| suite.iter().map(move |scenario| (controller, scenario))).collect();
    let judged = in_parallel(jobs, &pairs, |(controller, scenario)| {
        let (name, link) = link(controller);
        play(scenario, name, link)
    })?;
    Ok(judged.chunks(suite.len()).map(<[Judgement]>::to_vec).collect())
}

/// What `work` makes of each task, in their order, over several threads.
fn in_parallel<T: Sync, R: Send>(
    jobs: usize,
    tasks: &[T],
    work: impl Fn(&T) -> Result<R, TrustError> + Sync,
) -> Result<Vec<R>, TrustError> {
    let next = AtomicUsize::new(0);
    let (sender, results) = mpsc::channel();
    let mut done: Vec<(usize, R)> = thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, tasks.len().max(1)) {
            let (sender, next, work) = (sender.clone(), &next, &work);
            scope.spawn(move || {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let Some(task) = tasks.get(number) else { break };
                    // Frames that a fault spoils are the experiment: nobody is to be warned of them.
                    let result = with_default(NoSubscriber::default(), || work(task)).map(|done| (number, done));
                    let is_over = result.is_err();
                    if sender.send(result).is_err() || is_over {
                        break;
                    }
                }
            });
        }
        drop(sender);
        results.iter().collect::<Result<_, TrustError>>()
    })?;
    done.sort_by_key(|(number, _)| *number);
    if done.len() == tasks.len() {
        Ok(done.into_iter().map(|(_, done)| done).collect())
    } else {
        Err(TrustError::Bench)
    }
}
