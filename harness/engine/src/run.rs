//! Plays all trials of all scenarios on several workers. No result depends on the order of trials.

use crate::applicability::{only_describes_bench_law, why_not_applicable};
use crate::executor::{Executor, ExecutorSettings, SafeEnds};
use crate::firmware_digest::FirmwareDigest;
use crate::plan::{Clock, LinkFactory, RigSession, RunError, RunHooks, RunPlan};
use crate::run_player::{RunPlayer, RunProgress, ScenarioResult};
use crate::timing::{Pacing, TimeBase};
use crate::trend;
use crate::trial;
use crate::workers::ResultSink;
use platebench_model::record::{
    Event, FinishedScenario, Firmware, FolderError, Host, InputRecord, KeepTraces, NotApplicable, RigRecord, RunFolder,
    RunRecord, ScenarioRecord, Tool, TrialJournal, TrialRecord, Verdict, to_hex,
};
use platebench_model::scenario::{Metric, OWN_LAW, Scenario};
use platebench_model::trace::AtPath as _;
use platebench_rig::{FaultInjector, RigSpec};
use platebench_verdict::Judgement;
use platebench_wire::{Identity, LawId, capabilities};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
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
    let RunHooks { cancel, operator, live_tap, on_event, trials_with_rows, kept_session } = hooks;
    let started = Instant::now();
    let law = |scenario| trial::law(scenario).map_err(|diagnostic| RunError::Scenario(Box::new(diagnostic)));
    let laws = plan.scenarios.iter().map(law).collect::<Result<Vec<_>, _>>()?;
    let others =
        plan.scenarios.iter().flat_map(|scenario| scenario.between.iter().chain(scenario.other_trials.as_deref()));
    others.into_iter().try_for_each(|scene| law(scene).map(|_| ()))?;
    let firmware = FirmwareDigest::of_rig(&plan.rig);
    let kept = kept_session.as_ref().and_then(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner).take());
    let mut first = match kept.filter(|session| !session.has_ended()) {
        Some(session) => session,
        None => RigSession::open_cancellable(FaultInjector::new(connect()?), &cancel)?,
    };
    check_controller(plan, &first)?;
    let plan = &with_own_law_if_unnumbered(plan, first.identity());
    let (plan, laws, not_applicable) = select_applicable(plan, laws, &mut first)?;
    let plan = &plan;
    for (scenario, law) in plan.scenarios.iter().zip(&laws) {
        trial::check_configuration(scenario, trial::law_number(scenario, *law, first.identity()))?;
    }
    let inputs = folder.store_inputs(&plan.scenarios)?;
    if plan.overrides.keep_traces != KeepTraces::None {
        plan.scenarios.iter().try_for_each(|scenario| folder.create_trace_folder(scenario))?;
    }
    let journal = TrialJournal::create(folder.output()).map_err(FolderError::from)?;
    let rig = rig_record(plan, &first, &firmware);
    let record = RunRecord { not_applicable, ..initial_record(plan, folder, rig, &inputs, &journal) };
    let identity = *first.identity();
    write(&record, folder)?;
    let mut recorder = RunRecorder { plan, record, journal, on_event };
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
    let player = RunPlayer::new(plan, laws, folder, &cancel, &live_tap, trials_with_rows);
    let played = player.play(&mut executors, &mut recorder);
    if played.is_ok() {
        for (number, result) in player.judge_unfinished() {
            recorder.finish_scenario(number, result);
        }
    }
    // Also after an error, because the record must state whether 0 V was confirmed.
    if let (Some(slot), Some(first)) = (&kept_session, executors.first_mut()) {
        *slot.lock().unwrap_or_else(PoisonError::into_inner) = first.rest();
    }
    drop(executors);
    let RunRecorder { mut record, journal, .. } = recorder;
    record.safe_confirmed = Some(ends.are_confirmed());
    record.drive_after_safe = ends.have_drive();
    if played.is_ok() {
        record.journal = Some(journal.finished().map_err(FolderError::from)?);
        record.complete = true;
        // It reads earlier runs, which may take seconds.
        if !cancel.is_cancelled() {
            record.cost = trend::cost_trends(&record, folder.path());
        }
    }
    record.update_verdict();
    record.wall_ms = Some(started.elapsed().as_secs_f64() * 1e3);
    let written = write(&record, folder);
    played?;
    written?;
    Ok(record)
}

fn write(record: &RunRecord, folder: &RunFolder) -> Result<(), FolderError> {
    Ok(record.write(folder.path()).at(folder.path())?)
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
fn with_own_law_if_unnumbered(plan: &RunPlan, identity: &Identity) -> RunPlan {
    let mut plan = plan.clone();
    if identity.laws == 0 && plan.overrides.law.is_none() {
        plan.scenarios.iter_mut().for_each(|scenario| scenario.set_law(OWN_LAW));
    }
    plan
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
        let law = protocol_law(scenario, law, &identity);
        let is_lockstep = matches!(plan.clock, Clock::Lockstep { .. });
        let missing = why_not_applicable(scenario, law, is_lockstep, session).map_err(RunError::Scenario)?;
        match missing {
            None => {
                let mut scenario = scenario.clone();
                if !scenario.has_own_law() {
                    law.name().clone_into(&mut scenario.controller.law);
                }
                selected.scenarios.push(scenario);
                selected_laws.push(law);
            }
            Some(reason) => {
                let (file, title) = (scenario.file.clone(), scenario.title.clone());
                let is_of_bench_law = only_describes_bench_law(scenario).as_ref() == Some(&reason);
                let expectations = if is_of_bench_law { scenario.not_applicable.len() } else { 0 };
                not_applicable.push(NotApplicable { file, title, reason, expectations });
            }
        }
    }
    Ok((selected, selected_laws, not_applicable))
}

/// Writes the results of the workers to the record and reports them as events.
struct RunRecorder<'a> {
    plan: &'a RunPlan,
    record: RunRecord,
    journal: TrialJournal,
    on_event: Box<dyn FnMut(Event) + 'a>,
}

impl RunRecorder<'_> {
    fn finish_scenario(&mut self, number: usize, result: ScenarioResult) {
        let Some(record) = self.record.scenarios.get_mut(number) else { return };
        record.time_limit_s = result.time_limit_s;
        complete_record(record, result.judgement, result.trials);
        // `--fail-fast` may leave a scenario without a trial, which has neither started nor ended.
        if !record.trials.is_empty() || record.time_limit_s.is_some() {
            (self.on_event)(Event::ScenarioFinished(Box::new(FinishedScenario::from(&*record))));
        }
    }
}

impl ResultSink<RunProgress, RunError> for RunRecorder<'_> {
    fn receive(&mut self, progress: RunProgress) -> Result<ControlFlow<()>, RunError> {
        match progress {
            RunProgress::Started(number) => {
                if let Some(scenario) = self.plan.scenarios.get(number) {
                    let (file, trials) = (scenario.file.clone(), scenario.trials.count);
                    (self.on_event)(Event::ScenarioStarted { file, trials });
                }
            }
            RunProgress::Played(number, trial, rows) => {
                if let Some(scenario) = self.record.scenarios.get(number) {
                    // The line is the proof of the trial, so it comes before the event.
                    self.journal.append(number, scenario, &self.record.rig, &trial).map_err(FolderError::from)?;
                    (self.on_event)(Event::TrialFinished { file: scenario.file.clone(), trial, rows });
                }
            }
            RunProgress::Judged(number, result) => self.finish_scenario(number, result),
        }
        Ok(ControlFlow::Continue(()))
    }
}

pub(crate) fn complete_record(record: &mut ScenarioRecord, judgement: Judgement, mut trials: Vec<TrialRecord>) {
    trials.sort_by_key(|trial| trial.index);
    record.verdict = judgement.verdict;
    record.expectations = judgement.expectations;
    record.trials = trials;
}

pub(crate) fn empty_record(scenario: &Scenario, inputs: Vec<InputRecord>) -> ScenarioRecord {
    ScenarioRecord {
        file: scenario.file.clone(),
        title: scenario.title.clone(),
        source: scenario.source.clone(),
        tags: scenario.tags.clone(),
        verdict: Verdict::Inconclusive,
        law: scenario.controller.law.clone(),
        model: scenario.model.name().to_owned(),
        period_ms: Some(scenario.controller.period.seconds() * 1e3),
        inputs,
        expectations: Vec::new(),
        not_applicable: scenario.not_applicable.clone(),
        requirement_texts: scenario.requirement_texts.clone(),
        time_limit_s: None,
        planned_trials: Some(scenario.trials.count),
        trials: Vec::new(),
    }
}

/// Lists the images of the bench's own firmware. `ci/firmware --update` writes this file.
const IMAGE_MANIFEST: &str = include_str!("../../../firmware-under-test/images/manifest.toml");

#[derive(Deserialize)]
struct ImageManifest {
    source_hash: String,
    images: BTreeMap<String, ImageEntry>,
}

#[derive(Deserialize)]
struct ImageEntry {
    sha256: String,
}

/// A copy of an image with other bytes is not the bench's own, although its identity is the same.
/// For a controller without a readable image, the build in its identity decides.
fn is_bench_firmware(rig: &str, identity: &Identity, firmware: &FirmwareDigest) -> bool {
    let Ok(manifest) = toml::from_str::<ImageManifest>(IMAGE_MANIFEST) else { return false };
    if [RigSpec::hosted(), RigSpec::emulated(None)].iter().any(|own| own.to_string() == rig) {
        return true;
    }
    let has_image = rig.parse::<RigSpec>().is_ok_and(|rig| rig.image().is_some());
    if let Some(digest) = firmware.sha256().filter(|_| has_image) {
        return manifest.images.values().any(|image| image.sha256 == digest);
    }
    manifest.source_hash.starts_with(&to_hex(&identity.build)) && identity.name.starts_with(b"platebench-")
}

fn rig_record(plan: &RunPlan, session: &RigSession, firmware: &FirmwareDigest) -> RigRecord {
    let identity = session.identity();
    let [major, minor, patch] = identity.version;
    RigRecord {
        name: plan.rig.clone(),
        firmware: Some(Firmware {
            name: session.firmware_name(),
            version: format!("{major}.{minor}.{patch}"),
            build: to_hex(&identity.build),
            chip: format!("{:#010x}", identity.chip),
        }),
        program_sha256: firmware.sha256().map(str::to_owned),
        bench_firmware: is_bench_firmware(&plan.rig, identity, firmware),
    }
}

fn initial_record(
    plan: &RunPlan,
    folder: &RunFolder,
    rig: RigRecord,
    inputs: &[Vec<InputRecord>],
    journal: &TrialJournal,
) -> RunRecord {
    let scenarios = plan.scenarios.iter().zip(inputs).map(|(scenario, inputs)| empty_record(scenario, inputs.clone()));
    RunRecord {
        format: platebench_model::record::FORMAT,
        sequence: folder.sequence(),
        verdict: Verdict::Inconclusive,
        complete: false,
        tool: Tool::running(),
        started: folder.started(),
        rig,
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
        journal: Some(journal.started()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::hosted("hosted", *b"platebench-host\0", "", true)]
    #[case::built_in_image("emulated", *b"platebench-f4\0\0\0", "0000000000000000", true)]
    #[case::own_build("exec:controller {port}", *b"platebench-host\0", "", true)]
    #[case::changed_copy("emulated:a.elf", *b"platebench-f4\0\0\0", "0000000000000000", false)]
    #[case::other_name("emulated:a.elf", *b"starter-c\0\0\0\0\0\0\0", "", false)]
    fn recognises_the_firmware_of_the_bench(
        #[case] rig: &str,
        #[case] name: [u8; 16],
        #[case] build: &str,
        #[case] is_own: bool,
    ) {
        let images: ImageManifest = toml::from_str(IMAGE_MANIFEST).unwrap();
        let digits = if build.is_empty() { &images.source_hash[..16] } else { build };
        let build = u64::from_str_radix(digits, 16).unwrap().to_be_bytes();
        let identity = Identity { version: [0; 3], capabilities: 0, laws: 0, build, chip: 0, unique: [0; 12], name };
        assert_eq!(is_bench_firmware(rig, &identity, &FirmwareDigest::of_rig(rig)), is_own);
    }

    #[test]
    fn a_patched_image_is_not_the_bench_firmware() {
        let images: ImageManifest = toml::from_str(IMAGE_MANIFEST).unwrap();
        let build = u64::from_str_radix(&images.source_hash[..16], 16).unwrap().to_be_bytes();
        let name = *b"platebench-f4\0\0\0";
        let identity = Identity { version: [0; 3], capabilities: 0, laws: 0, build, chip: 0, unique: [0; 12], name };
        let folder = tempfile::tempdir().unwrap();
        let elf = folder.path().join("a.elf");
        let rig = RigSpec::emulated(Some(elf.clone())).to_string();
        let mut bytes = platebench_rig::BUILT_IN_IMAGE.to_vec();
        std::fs::write(&elf, &bytes).unwrap();
        assert!(is_bench_firmware(&rig, &identity, &FirmwareDigest::of_rig(&rig)));
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&elf, &bytes).unwrap();
        assert!(!is_bench_firmware(&rig, &identity, &FirmwareDigest::of_rig(&rig)));
    }
}
