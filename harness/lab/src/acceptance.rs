//! Conducts a session step by step.
//!
//! ```text
//! open ──► identity ──► questions ──► self-test ──► trust ──► scenarios ──► questions ──► seal
//!            └── each step: started (written) → done (written, with its files) ──┘
//! ```
//!
//! A resumed session repeats the interrupted step, but no step that is done.
//!
//! It continues only with the same bench, rig, plan, inputs and firmware. The result is a sealed,
//! signed record.

pub mod judge;
pub mod page;
pub mod plan;
pub mod seal;
pub mod session_record;
mod steps;
mod verify;

pub use judge::PlanDecision;
pub use plan::AcceptancePlan;
pub use seal::{PublicKey, SecretKey};
pub use session_record::{AcceptError, SessionDetails, SessionRecord};
pub use steps::{SessionConfig, SessionHooks, SessionObserver};
pub use verify::{Finding, Signer, Verification, verify};

use crate::acceptance::judge::{judge_requirements, today};
use crate::acceptance::plan::RepeatedScenario;
use crate::acceptance::seal::{MANIFEST_FILE, MAX_MANIFEST_BYTES, SIGNATURE_FILE, write_manifest};
use crate::acceptance::session_record::{
    Attempt, BUDGET, BenchRecord, ClockRecord, FILE, FORMAT, FirmwareRecord, PLAN, STEPS, SignatureRecord, StepKind,
    StepRecord, write_file,
};
use crate::acceptance::steps::{
    ScenarioRun, StepAction, ask_operator, measure_trust, run_self_test, step_actions, step_records,
};
use platebench_document::format::count;
use platebench_engine::{Clock, FirmwareDigest, Pacing, Question, QuestionKind, RunError};
use platebench_model::quoted;
use platebench_model::record::{
    self, Assessment, Firmware, Host, InputRecord, RigRecord, RunOutcome, RunRecord, Tool, Verdict, sha256,
    sha256_of_file, to_hex, utc_timestamp,
};
use platebench_model::trace::{AtPath, OutputFolder, read_regular_file};
use platebench_report::{console, scripts_not_played, traceability};
use platebench_rig::{CancelToken, ConnectOptions, Session};
use std::fs::{self, TryLockError};
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
        check_same_firmware(session.record.firmware.as_ref(), &session.read_firmware_identity(hooks.cancel)?)?;
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
    output: OutputFolder,
}

impl<'a> SessionRunner<'a> {
    fn open(config: &'a SessionConfig, hooks: &SessionHooks<'_>) -> Result<Self, AcceptError> {
        let folder = &config.out;
        let exists = folder.join(FILE).exists();
        if config.resume && !exists {
            return Err(AcceptError::NoSession(folder.clone()));
        }
        let new = new_session_record(config)?;
        let output = OutputFolder::create(folder)?;
        match output.handle().try_lock() {
            Err(TryLockError::WouldBlock) => return Err(AcceptError::InUse(folder.clone())),
            locked => locked.map_err(io::Error::from).at(folder)?,
        }
        output.remove_temporary_files()?;
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
        Ok(Self { config, record, output })
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
        let steps = self.output.create_folder(STEPS)?;
        let folder = steps.path().join(&step.id);
        if folder.symlink_metadata().is_ok() {
            steps.remove_folder(&step.id)?;
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
                steps.open_folder(&step.id)?.sync_tree()?;
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
            StepAction::Identity => self.record_identity(step, hooks.cancel),
            StepAction::Ask(ask) => ask_operator(ask, &self.config.rig, step, hooks.operator, hooks.cancel),
            StepAction::SelfTest => {
                let real_time = matches!(self.config.clock, Clock::RealTime(_));
                run_self_test(plan, real_time, folder, step, hooks)
            }
            StepAction::Trust => measure_trust(plan, folder, step, hooks.cancel),
            StepAction::Scenario(planned) => self.run_scenario(planned, folder, step, hooks),
        }
    }

    fn record_identity(&mut self, step: &mut StepRecord, cancel: &CancelToken) -> Result<(), AcceptError> {
        let identity = self.read_firmware_identity(cancel)?;
        let Firmware { name, version, build, chip } = &identity.firmware;
        let board = if self.config.rig.is_simulated() {
            "no board".to_owned()
        } else {
            format!("chip {chip}, number {}", identity.unique)
        };
        step.reason = Some(format!("{} {version}, build {build}, {board}", quoted(name)));
        step.verdict = Some(Verdict::Pass);
        self.record.firmware = Some(identity);
        Ok(())
    }

    fn run_scenario(
        &self,
        planned: &RepeatedScenario,
        folder: &Path,
        step: &mut StepRecord,
        hooks: &mut SessionHooks<'_>,
    ) -> Result<(), AcceptError> {
        let SessionConfig { rig, clock, jobs, .. } = self.config;
        let (scenario, trials) = (&planned.scenario, planned.repetitions);
        let run = ScenarioRun { scenario, trials, rig, clock: *clock, jobs: *jobs };
        let record = run.play(folder, hooks)?;
        if let Some(known) = &self.record.firmware {
            check_controller(known, &record.rig)?;
        }
        platebench_report::page::write(&record, folder)?;
        traceability::write(&record, folder)?;
        step.run_sha256 = Some(run_sha256(folder)?);
        step.lost = Assessment::of(&record).outcome == RunOutcome::Unreachable;
        step.verdict = Some(record.verdict);
        let expectations: Vec<_> = record.scenarios.iter().flat_map(|scenario| &scenario.expectations).collect();
        let passed = expectations.iter().filter(|expectation| expectation.verdict == Verdict::Pass).count();
        let trials: usize = record.scenarios.iter().map(|scenario| scenario.trials.len()).sum();
        let trials = count(trials, "trial");
        let why = (record.verdict != Verdict::Pass).then(|| format!(": {}", console::verdict_reason(&record)));
        let not_played = scripts_not_played(&record).map(|scripts| format!("; not played: {scripts}"));
        let why = why.unwrap_or_default() + &not_played.unwrap_or_default();
        step.reason = Some(format!("{passed} of {} expectations met in {trials}{why}", expectations.len()));
        Ok(())
    }

    fn read_firmware_identity(&self, cancel: &CancelToken) -> Result<FirmwareRecord, AcceptError> {
        let link = self
            .config
            .clock
            .connect(&self.config.rig, &ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() })
            .map_err(RunError::from)?;
        let session = Session::open_cancellable(link, cancel).map_err(RunError::from)?;
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
            image_sha256: FirmwareDigest::of_rig(&self.config.rig.to_string()).sha256().map(str::to_owned),
        })
    }

    fn judge_and_seal(mut self) -> Result<SessionRecord, AcceptError> {
        let folder = &self.config.out;
        for name in [MANIFEST_FILE, SIGNATURE_FILE] {
            if folder.join(name).symlink_metadata().is_ok() {
                self.output.remove_file(name)?;
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
        write_manifest(folder)?;
        if let Some(key) = &self.config.signing_key {
            let path = folder.join(MANIFEST_FILE);
            write_file(folder, SIGNATURE_FILE, &key.sign(&read_regular_file(&path, MAX_MANIFEST_BYTES).at(&path)?))?;
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
    if record.must_be_signed && !new.must_be_signed {
        return Err(AcceptError::NotSigned);
    }
    record.must_be_signed = new.must_be_signed;
    check_run_hashes(folder, &record)?;
    let (known, SessionDetails { operator, place, notes }) = (&mut record.details, config.details.clone());
    // An option corrects what an earlier part of the session stored.
    known.operator = operator.or(known.operator.take());
    known.place = place.or(known.place.take());
    known.notes = notes.or(known.notes.take());
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
    record.complete && exists(MANIFEST_FILE) && (record.signature.is_none() || exists(SIGNATURE_FILE))
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

pub(crate) fn new_session_record(config: &SessionConfig) -> Result<SessionRecord, AcceptError> {
    let SessionConfig { plan, rig, clock, details, .. } = config;
    let inputs = plan.scenarios.iter().flat_map(|planned| {
        let scenario = &planned.scenario;
        scenario.inputs.iter().enumerate().map(move |(number, input)| {
            let name = input.path.file_name().unwrap_or_default().to_string_lossy();
            let file = if number == 0 { scenario.file.clone() } else { format!("{}: {name}", scenario.file) };
            InputRecord { file, sha256: sha256(&input.bytes) }
        })
    });
    let (time_scale, pacing) = match clock {
        Clock::Lockstep { .. } => (1.0, "bench"),
        Clock::RealPlate => (1.0, "target"),
        Clock::RealTime(pace) => (pace.time_scale, if pace.pacing == Pacing::Target { "target" } else { "bench" }),
    };
    Ok(SessionRecord {
        format: FORMAT,
        verdict: Verdict::Inconclusive,
        complete: false,
        title: plan.title.clone(),
        details: details.clone(),
        started: utc_timestamp(),
        finished: None,
        resumed: Vec::new(),
        bench: bench_record()?,
        rig: rig.to_string(),
        clock: ClockRecord { name: clock.kind().to_string(), time_scale, pacing: pacing.to_owned() },
        firmware: None,
        plan: InputRecord { file: PLAN.to_owned(), sha256: sha256(&plan.bytes) },
        decision: plan
            .decision
            .as_ref()
            .map(|decision| decision.record(today(), &config.waived_calibrations))
            .transpose()?,
        inputs: inputs.collect(),
        steps: step_records(plan),
        requirements: Vec::new(),
        must_be_signed: config.signing_key.is_some(),
        signature: None,
    })
}

fn bench_record() -> Result<BenchRecord, AcceptError> {
    // `/proc/self/exe` is the running program, even if its file was replaced after the start.
    let running = fs::read("/proc/self/exe").or_else(|_| std::env::current_exe().and_then(fs::read));
    let program = running.at(Path::new("the program of the bench"))?;
    Ok(BenchRecord { tool: Tool::running(), sha256: sha256(&program), host: Host::current() })
}

pub(crate) fn check_run_hashes(folder: &Path, record: &SessionRecord) -> Result<(), AcceptError> {
    for step in record.steps.iter().filter(|step| step.done) {
        if let Some(then) = &step.run_sha256 {
            let now = run_sha256(&folder.join(STEPS).join(&step.id))?;
            if now != *then {
                return Err(changed_error(&format!("{STEPS}/{}/{}", step.id, record::RECORD_FILE), then, &now));
            }
        }
    }
    Ok(())
}

pub(crate) fn run_sha256(folder: &Path) -> Result<String, AcceptError> {
    let path = folder.join(record::RECORD_FILE);
    Ok(sha256_of_file(&path).at(&path)?)
}

pub(crate) fn changed_error(what: &str, then: &str, now: &str) -> AcceptError {
    AcceptError::Changed { what: what.to_owned(), then: then.to_owned(), now: now.to_owned() }
}

pub(crate) fn format_firmware(firmware: &Firmware) -> String {
    let Firmware { name, version, build, chip } = firmware;
    format!("{} {version}, build {build}, chip {chip}", quoted(name))
}

pub(crate) fn check_unchanged(then: &SessionRecord, now: &SessionRecord) -> Result<(), AcceptError> {
    let bench = |record: &SessionRecord| format!("{} {}", record.bench.tool.version, record.bench.sha256);
    let clock = |record: &SessionRecord| {
        let ClockRecord { name, time_scale, pacing } = &record.clock;
        format!("{name}, time scale {time_scale}, paced by {pacing}")
    };
    let budget = |record: &SessionRecord| {
        record.decision.as_ref().map_or_else(|| "none".to_owned(), |decision| decision.budget.sha256.clone())
    };
    let waived = |record: &SessionRecord| {
        let instruments = record.decision.iter().flat_map(|decision| &decision.instruments);
        instruments.filter(|each| each.waived).map(|each| each.name.clone()).collect::<Vec<_>>().join(", ")
    };
    let pairs = [
        ("the bench", bench(then), bench(now)),
        ("the plan", then.plan.sha256.clone(), now.plan.sha256.clone()),
        ("the uncertainty budget", budget(then), budget(now)),
        ("the list of waived calibrations", waived(then), waived(now)),
        ("the rig", then.rig.clone(), now.rig.clone()),
        ("the clock", clock(then), clock(now)),
    ];
    for (what, then, now) in &pairs {
        if then != now {
            return Err(changed_error(what, then, now));
        }
    }
    let names = |record: &SessionRecord| record.inputs.iter().map(|input| input.file.clone()).collect::<Vec<_>>();
    if names(then) != names(now) {
        return Err(changed_error("the list of scenarios and plates", &names(then).join(", "), &names(now).join(", ")));
    }
    for (then, now) in then.inputs.iter().zip(&now.inputs) {
        if then.sha256 != now.sha256 {
            return Err(changed_error(&then.file, &then.sha256, &now.sha256));
        }
    }
    Ok(())
}

/// Fails if `rig` had another controller or program than the session.
pub(crate) fn check_controller(known: &FirmwareRecord, rig: &RigRecord) -> Result<(), AcceptError> {
    if let Some(played) = rig.firmware.as_ref().filter(|played| **played != known.firmware) {
        return Err(changed_error("the firmware", &format_firmware(&known.firmware), &format_firmware(played)));
    }
    match (&known.image_sha256, &rig.program_sha256) {
        (Some(then), Some(now)) if then != now => Err(changed_error("the program of the controller", then, now)),
        _ => Ok(()),
    }
}

pub(crate) fn check_same_firmware(then: Option<&FirmwareRecord>, now: &FirmwareRecord) -> Result<(), AcceptError> {
    let describe = |record: &FirmwareRecord| {
        let image = record.image_sha256.as_deref().unwrap_or("none");
        format!("{}, number {}, image {image}", format_firmware(&record.firmware), record.unique)
    };
    match then {
        Some(then) if then != now => Err(changed_error("the firmware", &describe(then), &describe(now))),
        _ => Ok(()),
    }
}
