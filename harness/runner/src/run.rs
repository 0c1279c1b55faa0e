//! All trials of all scenarios, over several workers, in an order that no result depends on.

use crate::configure;
use crate::event::Event;
use crate::folder::{FolderError, RunFolder, hexadecimal};
use crate::plan::{Cancel, Clock, Company, Connect, Plan, RunError};
use crate::real_plate::Nobody;
use crate::real_time::{Pace, Pacing};
use crate::trend;
use crate::watch::Watch;
use crate::worker::{Done, Progress, Run, Session, Task, Work, end, trials_of};
use platebench_rig::Faulty;
use platebench_scenario::Scenario;
use platebench_verdict::record::{Firmware, Host, InputRecord, ModelChoice, RigRecord, Tool};
use platebench_verdict::{Decision, RunRecord, ScenarioRecord, TrialMeasures, Verdict, judge, sequential};
use platebench_wire::capabilities;
use std::cmp::Reverse;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use tracing::info;

/// Plays `plan` into `folder` and returns the record, which is also in the folder.
///
/// # Errors
/// [`RunError`]; what was whole by then can still be judged and reported.
pub fn run(
    plan: &Plan,
    folder: &RunFolder,
    connect: &Connect<'_>,
    cancel: &Cancel,
    tell: &mut dyn FnMut(Event),
) -> Result<RunRecord, RunError> {
    let company = Company { person: &Nobody, watch: &Watch::default() };
    run_in_company(plan, folder, connect, cancel, company, tell)
}

/// As [`run()`], in company.
///
/// # Errors
/// As for [`run()`].
pub fn run_in_company(
    plan: &Plan,
    folder: &RunFolder,
    connect: &Connect<'_>,
    cancel: &Cancel,
    company: Company<'_>,
    tell: &mut dyn FnMut(Event),
) -> Result<RunRecord, RunError> {
    let laws = plan.scenarios.iter().map(configure::law).collect::<Result<Vec<_>, _>>();
    let laws = laws.map_err(|diagnostic| RunError::Scenario(Box::new(diagnostic)))?;
    let first = Session::open(Faulty::new(connect()?))?;
    if let Clock::RealTime(Pace { pacing: Pacing::Target, .. }) = plan.clock
        && !first.identity().can(capabilities::TARGET_PACED)
    {
        return Err(RunError::NoPace(first.firmware_name()));
    }
    if plan.clock == Clock::OwnPlate {
        if !first.identity().can(capabilities::OWN_PLATE) {
            return Err(RunError::NoPlate(first.firmware_name()));
        }
        if let Some(harmed) = plan.scenarios.iter().find(|scenario| !scenario.faults.is_empty()) {
            let what = "faults are for an emulated plate; a real one can break, expected no [[fault]]";
            return Err(RunError::Scenario(Box::new(harmed.diagnose("fault", what))));
        }
    }
    for scenario in &plan.scenarios {
        configure::can_be_told(scenario, first.identity())
            .map_err(|diagnostic| RunError::Scenario(Box::new(diagnostic)))?;
    }
    let inputs = folder.store_inputs(&plan.scenarios)?;
    for scenario in &plan.scenarios {
        folder.prepare(scenario)?;
    }
    let mut record = first_record(plan, folder, &first, &inputs);
    let identity = *first.identity();
    write(&record, folder)?;
    // The controller that introduced itself is the first worker's; the others find their own.
    let mut sessions: Vec<Option<Session>> = (0..plan.jobs.max(1)).map(|_| None).collect();
    if let Some(session) = sessions.first_mut() {
        *session = Some(first);
    }
    let unconfirmed = AtomicBool::new(false);
    let run = Run { plan, laws: &laws, folder, connect, identity, cancel, company, unconfirmed: &unconfirmed };
    let played = play(run, &mut sessions, &mut record, tell);
    // However it ended, what the controllers say of 0 V is in the record.
    for session in &mut sessions {
        end(session, &unconfirmed);
    }
    record.safe_confirmed = Some(!unconfirmed.load(Ordering::Relaxed));
    if played.is_ok() {
        record.complete = true;
        record.decide();
        record.cost = trend::cost(&record, folder.path());
    }
    let written = write(&record, folder);
    played?;
    written?;
    Ok(record)
}

fn write(record: &RunRecord, folder: &RunFolder) -> Result<(), FolderError> {
    record.write(folder.path()).map_err(|source| FolderError::Io { path: folder.path().to_owned(), source })
}

/// Plays until every scenario is decided, and judges each as soon as it is.
fn play(
    run: Run<'_>,
    sessions: &mut [Option<Session>],
    record: &mut RunRecord,
    tell: &mut dyn FnMut(Event),
) -> Result<(), RunError> {
    let Run { plan, cancel, folder, .. } = run;
    let mut collected: Vec<Vec<Done>> = plan.scenarios.iter().map(|_| Vec::new()).collect();
    // Trials up to the next look at a scenario, all scenarios together; then those that are not decided go on.
    let mut goals: Vec<u32> = plan.scenarios.iter().map(|scenario| next_goal(scenario, &[])).collect();
    let mut tasks: Vec<Task> = (0..).zip(&goals).flat_map(|(scenario, goal)| trials_of(scenario, 0, *goal)).collect();
    while !tasks.is_empty() {
        // The longest first, so that no worker is left with one while the others have nothing to do.
        tasks.sort_by_key(|task| Reverse(plan.scenarios.get(task.scenario).map(|scenario| scenario.duration)));
        let batch = std::mem::take(&mut tasks);
        let work = Work { run, tasks: &batch, next: AtomicUsize::new(0) };
        thread::scope(|scope| {
            let (sender, results) = mpsc::channel();
            for session in sessions.iter_mut().take(batch.len()) {
                let (work, sender) = (&work, sender.clone());
                scope.spawn(move || work.worker(session, &sender));
            }
            drop(sender);
            for result in results {
                let result = result.inspect_err(|_| cancel.cancel());
                let (number, done) = match result? {
                    Progress::Started(number) => {
                        if let Some(scenario) = plan.scenarios.get(number) {
                            let (file, trials) = (scenario.file.clone(), scenario.trials.count);
                            tell(Event::ScenarioStarted { file, trials });
                        }
                        continue;
                    }
                    Progress::Done(number, done) => (number, done),
                };
                let (Some(scenario), Some(of_scenario), Some(goal), Some(scenario_record)) = (
                    plan.scenarios.get(number),
                    collected.get_mut(number),
                    goals.get_mut(number),
                    record.scenarios.get_mut(number),
                ) else {
                    continue;
                };
                tell(Event::TrialFinished { file: scenario.file.clone(), trial: Box::new(done.record.clone()) });
                of_scenario.push(*done);
                if of_scenario.len() < *goal as usize {
                    continue;
                }
                let next = next_goal(scenario, of_scenario);
                if next > *goal {
                    info!(scenario = %scenario.file, played = *goal, next, "not decided yet");
                    tasks.extend(trials_of(number, *goal, next));
                    *goal = next;
                    continue;
                }
                finish(scenario, std::mem::take(of_scenario), scenario_record);
                info!(scenario = %scenario.file, verdict = %scenario_record.verdict, "scenario judged");
                let finished = Box::new(scenario_record.clone());
                write(record, folder)?;
                tell(Event::ScenarioFinished(finished));
            }
            Ok::<(), RunError>(())
        })?;
        if cancel.is_cancelled() {
            return Err(RunError::Cancelled);
        }
    }
    if cancel.is_cancelled() {
        return Err(RunError::Cancelled);
    }
    Ok(())
}

/// How many trials of a scenario there have to be for the next look at them; as many as there are where they decide.
fn next_goal(scenario: &Scenario, played: &[Done]) -> u32 {
    let measures: Vec<TrialMeasures> = played.iter().map(|done| done.measures.clone()).collect();
    match sequential(scenario, &measures) {
        Decision::Go { trials } => trials,
        Decision::Stop(_) => played.len() as u32,
    }
}

/// Judges a scenario whose trials have all been played.
pub(crate) fn finish(scenario: &Scenario, mut trials: Vec<Done>, record: &mut ScenarioRecord) {
    trials.sort_by_key(|done| done.record.index);
    let (measures, records): (Vec<_>, Vec<_>) = trials.into_iter().map(|done| (done.measures, done.record)).unzip();
    let judgement = judge(scenario, &measures);
    record.verdict = judgement.verdict;
    record.expectations = judgement.expectations;
    record.trials = records;
}

/// The record of a scenario that nothing is known of yet.
pub(crate) fn empty_record(scenario: &Scenario, inputs: Vec<InputRecord>) -> ScenarioRecord {
    ScenarioRecord {
        file: scenario.file.clone(),
        title: scenario.title.clone(),
        source: scenario.source.clone(),
        verdict: Verdict::Inconclusive,
        law: scenario.controller.law.clone(),
        model: scenario.tier.name().to_owned(),
        model_choice: Some(ModelChoice {
            asked: scenario.model.asked_name().to_owned(),
            bound: Some(scenario.model.bound).filter(|bound| bound.is_finite()),
            budget: scenario.model.budget,
        }),
        inputs,
        expectations: Vec::new(),
        trials: Vec::new(),
    }
}

fn first_record(plan: &Plan, folder: &RunFolder, session: &Session, inputs: &[Vec<InputRecord>]) -> RunRecord {
    let scenarios = plan.scenarios.iter().zip(inputs).map(|(scenario, inputs)| empty_record(scenario, inputs.clone()));
    let identity = session.identity();
    let [major, minor, patch] = identity.version;
    RunRecord {
        format: platebench_verdict::record::FORMAT,
        verdict: Verdict::Inconclusive,
        complete: false,
        tool: Tool { name: "platebench".to_owned(), version: env!("CARGO_PKG_VERSION").to_owned() },
        started: folder.started(),
        rig: RigRecord {
            name: plan.rig.clone(),
            firmware: Some(Firmware {
                name: session.firmware_name(),
                version: format!("{major}.{minor}.{patch}"),
                build: hexadecimal(&identity.build),
                chip: format!("{:#010x}", identity.chip),
            }),
        },
        clock: plan.clock.name().to_owned(),
        overrides: plan.overrides.clone(),
        safe_confirmed: None,
        host: Host { os: std::env::consts::OS.to_owned(), arch: std::env::consts::ARCH.to_owned() },
        scenarios: scenarios.collect(),
        cost: Vec::new(),
    }
}
