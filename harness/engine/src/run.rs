//! Selects the scenarios of a plan that apply to the controller, and plays all their trials on
//! several workers. No result depends on the order of trials.

use crate::applicability::{only_describes_bench_law, why_not_applicable};
use crate::executor::{Executor, ExecutorSettings, SafeEnds};
use crate::firmware_digest::FirmwareDigest;
use crate::plan::{Clock, LinkFactory, RigSession, RunError, RunHooks, RunPlan};
use crate::run_player::{RunPlayer, SelectedScenario};
use crate::run_recorder::{RunRecorder, initial_record, rig_record};
use crate::timing::{Pacing, TimeBase};
use crate::trend;
use crate::trial;
use platebench_model::record::{FolderError, KeepTraces, NotApplicable, RunFolder, RunRecord, TrialJournal};
use platebench_model::scenario::{Metric, OWN_LAW, Scenario};
use platebench_rig::FaultInjector;
use platebench_wire::{Identity, LawId, capabilities};
use std::borrow::Cow;
use std::sync::{Arc, PoisonError};
use std::time::Instant;

/// Plays the plan and writes record and traces into `folder`. The record is written at the start
/// with everything that is selected, and at the end. In between, each trial is sealed in the
/// journal before its event is sent, so that `platebench report --rejudge` judges it after any end.
pub fn run(
    plan: &RunPlan,
    folder: &RunFolder,
    connect: &LinkFactory<'_>,
    hooks: RunHooks<'_>,
) -> Result<RunRecord, RunError> {
    let RunHooks { cancel, operator, live_tap, mut on_event, trials_with_rows, kept_session } = hooks;
    let started = Instant::now();
    for scenario in &plan.scenarios {
        let others = scenario.between.iter().chain(scenario.other_trials.as_deref());
        std::iter::once(scenario).chain(others).try_for_each(|scene| law_of(scene).map(drop))?;
    }
    let firmware = FirmwareDigest::of_rig(&plan.rig);
    let kept = kept_session.as_ref().and_then(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner).take());
    let mut first = match kept.filter(|session| !session.has_ended()) {
        Some(session) => session,
        None => RigSession::open_cancellable(FaultInjector::new(connect()?), &cancel)?,
    };
    check_controller(plan, &first)?;
    let (selected, not_applicable) = select_applicable(plan, &mut first)?;
    for SelectedScenario { scenario, law } in &selected {
        trial::check_configuration(scenario, trial::law_number(scenario, *law, first.identity()))?;
    }
    let scenarios: Vec<&Scenario> = selected.iter().map(|selected| &*selected.scenario).collect();
    let inputs = folder.store_inputs(&scenarios)?;
    if plan.overrides.keep_traces != KeepTraces::None {
        scenarios.iter().try_for_each(|scenario| folder.create_trace_folder(scenario))?;
    }
    let journal = TrialJournal::create(folder.output()).map_err(FolderError::from)?;
    let identity = *first.identity();
    let rig = rig_record(plan, &first, &firmware);
    let mut record = initial_record(plan, folder, rig, scenarios.into_iter().zip(inputs), &journal);
    record.not_applicable = not_applicable;
    let recorder = RunRecorder { record, journal };
    recorder.write(folder)?;
    let ends = SafeEnds::default();
    let settings = ExecutorSettings {
        clock: plan.clock,
        own_clock: plan.own_clock,
        long_scripts: plan.overrides.long_scripts,
        operator,
        identity: Arc::new(identity.into()),
        firmware: Some(&firmware),
        keeps_session: kept_session.is_some(),
        ..ExecutorSettings::lockstep(&cancel)
    };
    let mut executors = vec![Executor::new(connect, settings.clone(), &ends).with_session(first)];
    executors.extend((1..plan.jobs).map(|_| Executor::new(connect, settings.clone(), &ends)));
    let player = RunPlayer::new(&plan.overrides, &selected, folder, &cancel, &live_tap, trials_with_rows, recorder);
    let played = player.play(&mut executors, &mut on_event);
    let mut recorder = player.finish(played.is_ok(), &mut on_event);
    // Also after an error, because the record must state whether 0 V was confirmed.
    if let (Some(slot), Some(first)) = (&kept_session, executors.first_mut()) {
        *slot.lock().unwrap_or_else(PoisonError::into_inner) = first.rest();
    }
    drop(executors);
    let record = &mut recorder.record;
    record.safe_confirmed = Some(ends.are_confirmed());
    record.drive_after_safe = ends.have_drive();
    if played.is_ok() {
        record.journal = Some(recorder.journal.finished().map_err(FolderError::from)?);
        record.complete = true;
        // It reads earlier runs, which may take seconds.
        if !cancel.is_cancelled() {
            record.cost = trend::cost_trends(record, folder.path());
        }
    }
    record.update_verdict();
    record.wall_ms = Some(started.elapsed().as_secs_f64() * 1e3);
    let written = recorder.write(folder);
    played?;
    written?;
    Ok(recorder.record)
}

fn law_of(scenario: &Scenario) -> Result<LawId, RunError> {
    trial::law(scenario).map_err(|diagnostic| RunError::Scenario(Box::new(diagnostic)))
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
        if let Some(scenario) = plan.scenarios.iter().find(|scenario| scenario.other_trials.is_some()) {
            let what = "a real plate is the same in all trials, expected no [other_trials]; remove it, or use \
                        --plate-mode emulated";
            return Err(RunError::Scenario(Box::new(scenario.diagnostic("other_trials", what))));
        }
    }
    Ok(())
}

/// The rules of the protocol hold for every law. A scenario that tests only them is played with the
/// first law that the controller announces if it does not announce that of the scenario.
fn protocol_law(scenario: &Scenario, law: LawId, identity: &Identity) -> LawId {
    let tests_rules_only = scenario.expectations.iter().all(|expect| expect.metric == Metric::ProtocolDifferences);
    let is_played = identity.has_law(law) || !tests_rules_only;
    let first = LawId::ALL.into_iter().find(|law| identity.has_law(*law));
    if is_played { law } else { first.unwrap_or(LawId::OpenLoop) }
}

/// A controller that announces no law has one of its own, unless `--law` requests another one. That
/// is no override: the law in the record of each scenario states it.
fn has_own_law(plan: &RunPlan, identity: &Identity) -> bool {
    identity.laws == 0 && plan.overrides.law.is_none()
}

fn select_applicable<'a>(
    plan: &'a RunPlan,
    session: &mut RigSession,
) -> Result<(Vec<SelectedScenario<'a>>, Vec<NotApplicable>), RunError> {
    let identity = *session.identity();
    let (mut selected, mut not_applicable) = (Vec::new(), Vec::new());
    for planned in &plan.scenarios {
        let mut scenario = Cow::Borrowed(planned);
        if has_own_law(plan, &identity) {
            scenario.to_mut().set_law(OWN_LAW);
        }
        let law = protocol_law(&scenario, law_of(planned)?, &identity);
        let is_lockstep = matches!(plan.clock, Clock::Lockstep { .. });
        if let Some(reason) = why_not_applicable(&scenario, law, is_lockstep, session).map_err(RunError::Scenario)? {
            let (file, title) = (scenario.file.clone(), scenario.title.clone());
            let is_of_bench_law = only_describes_bench_law(&scenario).as_ref() == Some(&reason);
            let expectations = if is_of_bench_law { scenario.not_applicable.len() } else { 0 };
            not_applicable.push(NotApplicable { file, title, reason, expectations });
            continue;
        }
        if !scenario.has_own_law() && scenario.controller.law != law.name() {
            law.name().clone_into(&mut scenario.to_mut().controller.law);
        }
        selected.push(SelectedScenario { scenario, law });
    }
    Ok((selected, not_applicable))
}
