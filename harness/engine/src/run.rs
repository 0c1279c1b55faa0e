//! Plays all trials of all scenarios on several workers. No result depends on the order of trials.

use crate::executor::{Executor, ExecutorSettings, RigSession, SafeEnds};
use crate::fault::chip_fault_plan;
use crate::plan::{Clock, LinkFactory, RunError, RunHooks, RunPlan};
use crate::real_time::{Pacing, TimeBase};
use crate::record_file::RecordFile;
use crate::worker::{CompletedTrial, Progress, RunContext, TrialTask, WorkQueue, result_channel, trial_tasks};
use crate::{configure, trend};
use platebench_model::record::{
    Event, FinishedScenario, Firmware, FolderError, Host, InputRecord, KeepTraces, NotApplicable, RigRecord, RunFolder,
    RunRecord, ScenarioRecord, Tool, TrialRecord, Verdict, to_hex,
};
use platebench_model::scenario::{Metric, Scenario};
use platebench_model::trace::AtPath as _;
use platebench_rig::{ChipFaultError, FaultInjector, Link};
use platebench_verdict::{Judgement, SequentialDecision, TrialMeasures, judge, judge_sequentially};
use platebench_wire::{LawId, capabilities};
use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;
use std::{fs, thread};
use tracing::info;

/// Plays the plan and writes record and traces into `folder`. After an error, `platebench judge`
/// can still judge the complete trials.
pub fn run(
    plan: &RunPlan,
    folder: &RunFolder,
    connect: &LinkFactory<'_>,
    mut hooks: RunHooks<'_>,
) -> Result<RunRecord, RunError> {
    let started = Instant::now();
    let law = |scenario| configure::law(scenario).map_err(|diagnostic| RunError::Scenario(Box::new(diagnostic)));
    let laws = plan.scenarios.iter().map(law).collect::<Result<Vec<_>, _>>()?;
    plan.scenarios.iter().flat_map(|scenario| &scenario.between).try_for_each(|scene| law(scene).map(|_| ()))?;
    let mut first = RigSession::open(FaultInjector::new(connect()?))?;
    check_controller(plan, &first)?;
    let (plan, laws, not_applicable) = select_applicable(plan, laws, &mut first)?;
    let plan = &plan;
    let inputs = folder.store_inputs(&plan.scenarios)?;
    if plan.overrides.keep_traces != KeepTraces::None {
        plan.scenarios.iter().try_for_each(|scenario| folder.create_trace_folder(scenario))?;
    }
    let mut record = initial_record(plan, folder, &first, &inputs);
    record.not_applicable = not_applicable;
    let identity = *first.identity();
    let mut file = RecordFile::new(folder);
    file.write(&record)?;
    let (ends, stop) = (SafeEnds::default(), AtomicBool::new(false));
    let settings = ExecutorSettings {
        clock: plan.clock,
        own_clock: plan.own_clock,
        operator: hooks.operator,
        identity: Some(identity),
        ..ExecutorSettings::lockstep(&hooks.cancel)
    };
    let mut executors = vec![Executor::new(connect, settings.clone(), &ends).with_session(first)];
    executors.extend((1..plan.jobs).map(|_| Executor::new(connect, settings.clone(), &ends)));
    let delay_boundaries: Vec<_> = plan.scenarios.iter().map(|_| OnceLock::new()).collect();
    let context = RunContext {
        plan,
        laws: &laws,
        delay_boundaries: &delay_boundaries,
        folder,
        cancel: &hooks.cancel,
        live_tap: &hooks.live_tap,
        trials_with_rows: hooks.trials_with_rows,
        stop: &stop,
    };
    let played = play_scenarios(context, &mut executors, &mut record, &mut file, &mut hooks.on_event);
    // Also after an error, because the record must state whether 0 V was confirmed.
    drop(executors);
    record.safe_confirmed = Some(ends.are_confirmed());
    record.drive_after_safe = ends.have_drive();
    if played.is_ok() {
        record.complete = true;
        record.update_verdict();
        record.cost = trend::cost_trends(&record, folder.path());
    }
    record.wall_ms = Some(started.elapsed().as_secs_f64() * 1e3);
    let written = file.write(&record);
    played?;
    written?;
    Ok(record)
}

fn check_controller(plan: &RunPlan, session: &RigSession) -> Result<(), RunError> {
    let identity = session.identity();
    if let Clock::RealTime(TimeBase { pacing: Pacing::Target, .. }) = plan.clock
        && !identity.has_capability(capabilities::TARGET_PACED)
    {
        return Err(RunError::NoTargetPacing(session.firmware_name()));
    }
    if plan.clock == Clock::RealPlate {
        if !identity.has_capability(capabilities::OWN_PLATE) {
            return Err(RunError::NoRealPlate(session.firmware_name()));
        }
        if let Some(scenario) = plan.scenarios.iter().find(|scenario| !scenario.faults.is_empty()) {
            let what =
                "a fault could break a real plate, expected no [[fault]]; remove it, or use --plate-mode emulated";
            return Err(RunError::Scenario(Box::new(scenario.diagnostic("fault", what))));
        }
        if let Some(scenario) = plan.scenarios.iter().find(|scenario| !scenario.between.is_empty()) {
            let what = "a real plate cannot play scenes between trials, expected no [[between]]; remove it, or use \
                        --plate-mode emulated";
            return Err(RunError::Scenario(Box::new(scenario.diagnostic("between", what))));
        }
    }
    Ok(())
}

/// Returns why the rig cannot apply the chip faults. Fails if the firmware lacks a fault's target.
fn missing_chip_faults(
    plan: &RunPlan,
    scenario: &Scenario,
    session: &mut RigSession,
) -> Result<Option<String>, RunError> {
    let faults = chip_fault_plan(scenario, 0);
    if faults.faults.is_empty() {
        return Ok(None);
    }
    let checked = match plan.clock {
        Clock::Lockstep { .. } => session.link_mut().set_chip_faults(&faults),
        Clock::RealTime(_) | Clock::RealPlate => Err(ChipFaultError::Unsupported),
    };
    match checked {
        Ok(()) => Ok(None),
        Err(error @ ChipFaultError::Unsupported) => Ok(Some(error.to_string())),
        Err(error) => Err(RunError::Scenario(Box::new(scenario.diagnostic("fault", error.to_string())))),
    }
}

/// Returns why the rig cannot measure the time of a control step, if the scenario expects it.
fn missing_step_time(plan: &RunPlan, scenario: &Scenario, session: &RigSession) -> Option<String> {
    // The handshake was an exchange, so a rig that measures has a value.
    let is_measured = matches!(plan.clock, Clock::Lockstep { .. }) && session.link().computing_time().is_some();
    let why = format!("{} needs the emulated chip and the clock lockstep", Metric::StepTime);
    (scenario.expects(Metric::StepTime) && !is_measured).then_some(why)
}

fn select_applicable(
    plan: &RunPlan,
    laws: Vec<LawId>,
    session: &mut RigSession,
) -> Result<(RunPlan, Vec<LawId>, Vec<NotApplicable>), RunError> {
    let identity = *session.identity();
    let mut selected = RunPlan { scenarios: Vec::new(), ..plan.clone() };
    let (mut selected_laws, mut not_applicable) = (Vec::new(), Vec::new());
    for (scenario, law) in plan.scenarios.iter().zip(laws) {
        let mut between = scenario.between.iter().filter_map(|scene| Some((scene, configure::law(scene).ok()?)));
        let is_compared =
            scenario.expects(Metric::ReferenceDifference) || scenario.expects(Metric::ProtocolDifferences);
        let missing = (is_compared && !matches!(plan.clock, Clock::Lockstep { .. }))
            .then(|| "the metrics that compare the controller with the reference need the clock lockstep".to_owned())
            .or(missing_chip_faults(plan, scenario, session)?)
            .or_else(|| missing_step_time(plan, scenario, session))
            .or_else(|| configure::missing_capability(scenario, law, &identity))
            .or_else(|| between.find_map(|(scene, law)| configure::missing_capability(scene, law, &identity)));
        match missing {
            None => {
                selected.scenarios.push(scenario.clone());
                selected_laws.push(law);
            }
            Some(reason) => {
                let (file, title) = (scenario.file.clone(), scenario.title.clone());
                not_applicable.push(NotApplicable { file, title, reason });
            }
        }
    }
    Ok((selected, selected_laws, not_applicable))
}

/// Played trials in order of completion. The next interim look needs `trials_until_look` trials.
struct ScenarioProgress {
    measures: Vec<TrialMeasures>,
    records: Vec<TrialRecord>,
    trials_until_look: u32,
}

impl ScenarioProgress {
    fn new(scenario: &Scenario) -> Self {
        let goal = match judge_sequentially(scenario, &[]) {
            SequentialDecision::Continue { trials } => trials,
            SequentialDecision::Stop(_) => 0,
        };
        Self { measures: Vec::new(), records: Vec::new(), trials_until_look: goal }
    }
}

fn play_scenarios(
    run: RunContext<'_>,
    executors: &mut [Executor<'_>],
    record: &mut RunRecord,
    file: &mut RecordFile<'_>,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), RunError> {
    let RunContext { plan, cancel, .. } = run;
    let mut progress: Vec<_> = plan.scenarios.iter().map(ScenarioProgress::new).collect();
    let tasks_of = |number: usize, trials| {
        let keeps_controller = plan.scenarios.get(number).is_some_and(Scenario::keeps_controller);
        trial_tasks(number, keeps_controller, trials)
    };
    // First all scenarios reach their first look. Then the undecided scenarios continue.
    let mut tasks: Vec<TrialTask> =
        (0..).zip(&progress).flat_map(|(number, progress)| tasks_of(number, 0..progress.trials_until_look)).collect();
    while !tasks.is_empty() && !run.stop.load(Ordering::Relaxed) {
        // Long trials come first, so that no worker ends long after the others.
        tasks.sort_by_key(|task| Reverse(plan.scenarios.get(task.scenario).map(|scenario| scenario.duration)));
        let batch = std::mem::take(&mut tasks);
        let work = WorkQueue { run, tasks: &batch, next: AtomicUsize::new(0) };
        thread::scope(|scope| {
            let (sender, results) = result_channel();
            for executor in executors.iter_mut().take(batch.len()) {
                let (work, sender) = (&work, sender.clone());
                scope.spawn(move || work.run_worker(executor, &sender));
            }
            drop(sender);
            loop {
                let result = match results.recv_timeout(file.time_left()) {
                    Ok(result) => result,
                    Err(RecvTimeoutError::Timeout) => {
                        file.write(record)?;
                        continue;
                    }
                    Err(RecvTimeoutError::Disconnected) => break,
                };
                // Dropped at the end of the iteration, when the result is handled.
                let (number, trial, _handled) = match result.inspect_err(|_| cancel.cancel())? {
                    Progress::Started(number) => {
                        if let Some(scenario) = plan.scenarios.get(number) {
                            let (file, trials) = (scenario.file.clone(), scenario.trials.count);
                            on_event(Event::ScenarioStarted { file, trials });
                        }
                        continue;
                    }
                    Progress::Completed(number, trial, handled) => (number, trial, handled),
                };
                let (Some(scenario), Some(progress), Some(scenario_record)) =
                    (plan.scenarios.get(number), progress.get_mut(number), record.scenarios.get_mut(number))
                else {
                    continue;
                };
                let CompletedTrial { measures, record: trial, rows } = *trial;
                progress.measures.push(measures);
                progress.records.push(trial.clone());
                on_event(Event::TrialFinished { file: scenario.file.clone(), trial: Box::new(trial), rows });
                if progress.records.len() < progress.trials_until_look as usize {
                    continue;
                }
                match judge_sequentially(scenario, &progress.measures) {
                    SequentialDecision::Continue { trials } => {
                        let played = progress.trials_until_look;
                        info!(scenario = %scenario.file, played, next = trials, "not decided yet");
                        tasks.extend(tasks_of(number, played..trials));
                        progress.trials_until_look = trials;
                    }
                    SequentialDecision::Stop(judgement) => {
                        let measures = std::mem::take(&mut progress.measures);
                        complete_record(scenario_record, judgement, std::mem::take(&mut progress.records));
                        if let KeepTraces::Worst(count) = plan.overrides.keep_traces {
                            keep_worst(run.folder, scenario, &measures, count, &mut scenario_record.trials)?;
                        }
                        info!(scenario = %scenario.file, verdict = %scenario_record.verdict, "scenario judged");
                        if plan.overrides.fail_fast && scenario_record.verdict == Verdict::Fail {
                            run.stop.store(true, Ordering::Relaxed);
                        }
                        let finished = Box::new(FinishedScenario::from(&*scenario_record));
                        file.mark_changed();
                        on_event(Event::ScenarioFinished(finished));
                    }
                }
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
    if run.stop.load(Ordering::Relaxed) {
        judge_unfinished(plan, progress, record, on_event);
    }
    Ok(())
}

/// Judges the scenarios that `--fail-fast` stopped early, by the trials that were played.
fn judge_unfinished(
    plan: &RunPlan,
    progress: Vec<ScenarioProgress>,
    record: &mut RunRecord,
    on_event: &mut dyn FnMut(Event),
) {
    let unfinished = plan.scenarios.iter().zip(progress).zip(&mut record.scenarios);
    for ((scenario, progress), record) in unfinished.filter(|(_, record)| record.expectations.is_empty()) {
        complete_record(record, judge(scenario, &progress.measures), progress.records);
        if !record.trials.is_empty() {
            on_event(Event::ScenarioFinished(Box::new(FinishedScenario::from(&*record))));
        }
    }
}

pub(crate) fn complete_record(record: &mut ScenarioRecord, judgement: Judgement, mut trials: Vec<TrialRecord>) {
    trials.sort_by_key(|trial| trial.index);
    record.verdict = judgement.verdict;
    record.expectations = judgement.expectations;
    record.trials = trials;
}

/// Keeps only the traces of the `count` trials with the smallest margins. Of two equal margins, the
/// earlier trial comes first.
fn keep_worst(
    folder: &RunFolder,
    scenario: &Scenario,
    measures: &[TrialMeasures],
    count: u32,
    trials: &mut [TrialRecord],
) -> Result<(), RunError> {
    let mut order: Vec<_> = measures.iter().map(|trial| (trial.margin(&scenario.expectations), trial.index)).collect();
    order.sort_by(|(margin, index), (other, later)| margin.total_cmp(other).then(index.cmp(later)));
    let removed: BTreeSet<u32> = order.iter().skip(count as usize).map(|(_, index)| *index).collect();
    for trial in trials.iter_mut().filter(|trial| removed.contains(&trial.index)) {
        let path = folder.path().join(&trial.trace);
        fs::remove_file(&path).at(&path).map_err(FolderError::from)?;
        trial.sha256 = None;
    }
    Ok(())
}

pub(crate) fn empty_record(scenario: &Scenario, inputs: Vec<InputRecord>) -> ScenarioRecord {
    ScenarioRecord {
        file: scenario.file.clone(),
        title: scenario.title.clone(),
        source: scenario.source.clone(),
        tags: scenario.tags.clone(),
        verdict: Verdict::Inconclusive,
        law: scenario.controller.law.clone(),
        model: scenario.tier.name().to_owned(),
        period_ms: Some(scenario.controller.period.seconds() * 1e3),
        inputs,
        expectations: Vec::new(),
        requirement_texts: scenario.requirement_texts.clone(),
        trials: Vec::new(),
    }
}

fn initial_record(plan: &RunPlan, folder: &RunFolder, session: &RigSession, inputs: &[Vec<InputRecord>]) -> RunRecord {
    let scenarios = plan.scenarios.iter().zip(inputs).map(|(scenario, inputs)| empty_record(scenario, inputs.clone()));
    let identity = session.identity();
    let [major, minor, patch] = identity.version;
    RunRecord {
        format: platebench_model::record::FORMAT,
        verdict: Verdict::Inconclusive,
        complete: false,
        tool: Tool::running(),
        started: folder.started(),
        rig: RigRecord {
            name: plan.rig.clone(),
            firmware: Some(Firmware {
                name: session.firmware_name(),
                version: format!("{major}.{minor}.{patch}"),
                build: to_hex(&identity.build),
                chip: format!("{:#010x}", identity.chip),
            }),
        },
        clock: plan.clock.kind(),
        overrides: plan.overrides.clone(),
        safe_confirmed: None,
        drive_after_safe: false,
        wall_ms: None,
        host: Host::current(),
        scenarios: scenarios.collect(),
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
    }
}
