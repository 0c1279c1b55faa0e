//! Conducts a session step by step.
//!
//! ```text
//! open ──► identity ──► questions ──► self-test ──► trust ──► scenarios ──► questions ──► seal
//!            └── each step: started (written) → done (written, with its files) ──┘
//! ```
//!
//! A resumed session repeats the interrupted step, but no step that is done.

use crate::acceptance::ask::ask_operator;
use crate::acceptance::config::{SessionConfig, SessionHooks};
use crate::acceptance::error::AcceptError;
use crate::acceptance::judge::judge_requirements;
use crate::acceptance::plan::PlannedScenario;
use crate::acceptance::provenance::{
    changed_error, check_run_hashes, check_same_firmware, check_unchanged, format_firmware, image_sha256,
    new_session_record, run_sha256,
};
use crate::acceptance::scenario_run::ScenarioRun;
use crate::acceptance::session_record::{
    Attempt, BUDGET, FILE, FirmwareRecord, PLAN, STEPS, SessionDetails, SessionRecord, SignatureRecord, StepKind,
    StepRecord, write_file,
};
use crate::acceptance::steps::{StepAction, step_actions};
use crate::acceptance::{manifest, page, self_test, signature};
use platebench_engine::{Clock, Question, QuestionKind, RunError};
use platebench_model::record::{Firmware, RunRecord, Verdict, to_hex, utc_timestamp};
use platebench_model::trace::{AtPath, read_regular_file, remove_temporary_files, sync_tree};
use platebench_report::format::count;
use platebench_report::traceability;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::Path;
use tracing::info;

/// Starts the session, or resumes it after an error or an interruption.
pub fn play_session(config: &SessionConfig, hooks: &mut SessionHooks<'_>) -> Result<SessionRecord, AcceptError> {
    let mut session = SessionRunner::open(config, hooks)?;
    let actions = step_actions(&config.plan);
    if session.record.steps.len() != actions.len() {
        let message = format!("the record has {} steps, the plan {}", session.record.steps.len(), actions.len());
        return Err(AcceptError::InvalidRecord { path: config.out.join(FILE), message });
    }
    let is_open = session.record.steps.iter().any(|step| !step.done);
    if is_open && session.record.firmware.is_some() {
        check_same_firmware(session.record.firmware.as_ref(), &session.read_firmware_identity()?)?;
    }
    for (index, action) in actions.iter().enumerate() {
        if session.record.steps.get(index).is_some_and(|step| step.done) {
            continue;
        }
        if hooks.cancel.is_cancelled() {
            return Err(AcceptError::Cancelled);
        }
        session.run_step(index, *action, hooks)?;
    }
    session.judge_and_seal()
}

/// State of a running session. It locks the folder of the record against other sessions.
struct SessionRunner<'a> {
    config: &'a SessionConfig,
    record: SessionRecord,
    _lock: File,
}

impl<'a> SessionRunner<'a> {
    fn open(config: &'a SessionConfig, hooks: &SessionHooks<'_>) -> Result<Self, AcceptError> {
        let folder = &config.out;
        let exists = folder.join(FILE).exists();
        if config.resume && !exists {
            return Err(AcceptError::NoSession(folder.clone()));
        }
        let new = new_session_record(config)?;
        fs::create_dir_all(folder).at(folder)?;
        let lock = File::open(folder).at(folder)?;
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => return Err(AcceptError::InUse(folder.clone())),
            locked => locked.map_err(io::Error::from).at(folder)?,
        }
        remove_temporary_files(folder)?;
        let record = if folder.join(FILE).exists() {
            resume(config, &new)?
        } else {
            if fs::read_dir(folder).at(folder)?.next().is_some() {
                return Err(AcceptError::FolderNotEmpty(folder.clone()));
            }
            ask_details(new, hooks)
        };
        record.write(folder)?;
        write_file(folder, PLAN, &config.plan.bytes)?;
        if let Some(decision) = &config.plan.decision {
            write_file(folder, BUDGET, &decision.budget.bytes)?;
        }
        Ok(Self { config, record, _lock: lock })
    }

    fn run_step(
        &mut self,
        index: usize,
        action: StepAction<'_>,
        hooks: &mut SessionHooks<'_>,
    ) -> Result<(), AcceptError> {
        let Some(stored) = self.record.steps.get_mut(index) else { return Ok(()) };
        stored.attempts.push(Attempt { started: utc_timestamp(), ended: None, broken_off: None });
        let mut step = stored.clone();
        let folder = self.config.out.join(STEPS).join(&step.id);
        if folder.exists() {
            fs::remove_dir_all(&folder).at(&folder)?;
        }
        self.record.write(&self.config.out)?;
        hooks.observer.step_started(&step);
        let result = self.run_action(action, &folder, &mut step, hooks);
        if let Some(attempt) = step.attempts.last_mut() {
            attempt.ended = Some(utc_timestamp());
            attempt.broken_off = result.as_ref().err().map(ToString::to_string);
        }
        if result.is_ok() {
            if folder.exists() {
                sync_tree(&folder)?;
            }
            step.done = true;
            hooks.observer.step_ended(&step);
        }
        let attempts = step.attempts.clone();
        if let Some(stored) = self.record.steps.get_mut(index) {
            // After an error, only the list of attempts changes, so that the step is repeated.
            if result.is_ok() { *stored = step } else { stored.attempts = attempts }
        }
        self.record.write(&self.config.out)?;
        result
    }

    fn run_action(
        &mut self,
        action: StepAction<'_>,
        folder: &Path,
        step: &mut StepRecord,
        hooks: &mut SessionHooks<'_>,
    ) -> Result<(), AcceptError> {
        let plan = &self.config.plan;
        match action {
            StepAction::Identity => self.record_identity(step),
            StepAction::Ask(ask) => ask_operator(ask, &self.config.rig, step, hooks.operator, hooks.cancel),
            StepAction::SelfTest => {
                let real_time = matches!(self.config.clock, Clock::RealTime(_));
                self_test::run_self_test(plan, real_time, folder, step, hooks)
            }
            StepAction::Trust => self_test::measure_trust(plan, folder, step, hooks.cancel),
            StepAction::Scenario(planned) => self.run_scenario(planned, folder, step, hooks),
        }
    }

    fn record_identity(&mut self, step: &mut StepRecord) -> Result<(), AcceptError> {
        let identity = self.read_firmware_identity()?;
        let Firmware { name, version, build, chip } = &identity.firmware;
        let board = if self.config.rig.is_simulated() {
            "no board".to_owned()
        } else {
            format!("chip {chip}, number {}", identity.unique)
        };
        step.reason = Some(format!("{name} {version}, build {build}, {board}"));
        step.verdict = Some(Verdict::Pass);
        self.record.firmware = Some(identity);
        Ok(())
    }

    fn run_scenario(
        &self,
        planned: &PlannedScenario,
        folder: &Path,
        step: &mut StepRecord,
        hooks: &mut SessionHooks<'_>,
    ) -> Result<(), AcceptError> {
        let SessionConfig { rig, clock, jobs, .. } = self.config;
        let (scenario, trials) = (&planned.scenario, planned.repetitions);
        let run = ScenarioRun { scenario, trials, rig, clock: *clock, jobs: *jobs };
        let record = run.play(folder, hooks)?;
        if let (Some(played), Some(known)) = (&record.rig.firmware, &self.record.firmware)
            && *played != known.firmware
        {
            return Err(changed_error("the firmware", &format_firmware(&known.firmware), &format_firmware(played)));
        }
        platebench_report::page::write(&record, folder)?;
        traceability::write(&record, folder)?;
        step.run_sha256 = Some(run_sha256(folder)?);
        step.lost = record.has_lost_controller() || record.safe_confirmed == Some(false);
        step.verdict = Some(record.verdict);
        let expectations: Vec<_> = record.scenarios.iter().flat_map(|scenario| &scenario.expectations).collect();
        let passed = expectations.iter().filter(|expectation| expectation.verdict == Verdict::Pass).count();
        let trials: usize = record.scenarios.iter().map(|scenario| scenario.trials.len()).sum();
        let trials = count(trials, "trial");
        step.reason = Some(format!("{passed} of {} expectations met in {trials}", expectations.len()));
        Ok(())
    }

    fn read_firmware_identity(&self) -> Result<FirmwareRecord, AcceptError> {
        let link = self
            .config
            .clock
            .connect(&self.config.rig, &platebench_rig::ConnectOptions::default())
            .map_err(RunError::from)?;
        let session = platebench_rig::Session::open(link).map_err(RunError::from)?;
        let identity = *session.identity();
        let name = session.firmware_name();
        session.close();
        let [major, minor, patch] = identity.version;
        Ok(FirmwareRecord {
            firmware: Firmware {
                name,
                version: format!("{major}.{minor}.{patch}"),
                build: to_hex(&identity.build),
                chip: format!("{:#010x}", identity.chip),
            },
            unique: to_hex(&identity.unique),
            image_sha256: image_sha256(&self.config.rig)?,
        })
    }

    fn judge_and_seal(mut self) -> Result<SessionRecord, AcceptError> {
        let folder = &self.config.out;
        for name in [manifest::FILE, signature::FILE] {
            let path = folder.join(name);
            if path.exists() {
                fs::remove_file(&path).at(&path)?;
            }
        }
        let runs = read_runs(folder, &self.record.steps)?;
        let plan = &self.config.plan;
        let (requirements, verdict) =
            judge_requirements(&plan.requirements, &self.record.steps, &runs, plan.decision.as_ref());
        self.record.requirements = requirements;
        self.record.verdict = verdict;
        self.record.complete = true;
        self.record.finished = Some(utc_timestamp());
        self.record.signature = self
            .config
            .signing_key
            .as_ref()
            .map(|key| SignatureRecord { algorithm: "ed25519".to_owned(), public_key: key.public_key().to_pem() });
        self.record.write(folder)?;
        write_file(folder, page::FILE, page::document(&self.record).to_html().as_bytes())?;
        manifest::write(folder)?;
        if let Some(key) = &self.config.signing_key {
            let path = folder.join(manifest::FILE);
            write_file(folder, signature::FILE, &key.sign(&read_regular_file(&path, manifest::MAX_BYTES).at(&path)?))?;
        }
        Ok(self.record)
    }
}

/// Reads the interrupted session. `new` is the record of a session that would start now.
fn resume(config: &SessionConfig, new: &SessionRecord) -> Result<SessionRecord, AcceptError> {
    let folder = &config.out;
    let mut record = SessionRecord::read(folder)?;
    if has_sealed_manifest(folder, &record) {
        return Err(AcceptError::Finished(folder.clone()));
    }
    check_unchanged(&record, new)?;
    check_run_hashes(folder, &record)?;
    let (known, SessionDetails { operator, place, notes }) = (&mut record.details, config.details.clone());
    known.operator = known.operator.take().or(operator);
    known.place = known.place.take().or(place);
    known.notes = known.notes.take().or(notes);
    record.resumed.push(utc_timestamp());
    info!(folder = %folder.display(), "session resumed");
    Ok(record)
}

fn ask_details(mut record: SessionRecord, hooks: &SessionHooks<'_>) -> SessionRecord {
    for (detail, text) in [
        (&mut record.details.operator, "Who is the operator?"),
        (&mut record.details.place, "Where does the session take place?"),
        (&mut record.details.notes, "Notes?"),
    ] {
        if detail.is_none() {
            let answer = hooks.operator.ask(Question { text, kind: QuestionKind::Text }, hooks.cancel);
            *detail = answer.text().filter(|text| !text.is_empty()).map(str::to_owned);
        }
    }
    record
}

fn has_sealed_manifest(folder: &Path, record: &SessionRecord) -> bool {
    let exists = |name: &str| folder.join(name).exists();
    record.complete && exists(manifest::FILE) && (record.signature.is_none() || exists(signature::FILE))
}

fn read_runs(folder: &Path, steps: &[StepRecord]) -> Result<Vec<(String, RunRecord)>, AcceptError> {
    let played = steps.iter().filter(|step| step.kind == StepKind::Scenario && step.done);
    played
        .map(|step| {
            let run =
                RunRecord::read(&folder.join(STEPS).join(&step.id)).map_err(platebench_engine::RejudgeError::from)?;
            Ok((step.id.clone(), run))
        })
        .collect()
}
