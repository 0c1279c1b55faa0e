//! From step to step.
//!
//! ```text
//! open ──► identity ──► questions ──► self-test ──► trust ──► scenarios ──► questions ──► close
//!            └── every step: begun (written) → done (written, with all that it left) ──┘
//! ```
//!
//! What has been begun and not ended when the session is cut off is done again as a whole; what has ended is never done again, whatever came of it.

use crate::ask::asked;
use crate::basis::{
    changed, evidence_is_there, first_record, image_sha256, run_sha256, same_firmware, shown_firmware, unchanged,
};
use crate::decide::decide;
use crate::durable;
use crate::error::AcceptError;
use crate::order::{Answer, Desk, Order, Question, may_have_a_board};
use crate::plan::{AnswerKind, Ask, Plan, Planned, When};
use crate::self_test;
use crate::session::{Attempt, FILE, FirmwareRecord, SessionRecord, SignatureRecord, StepKind, StepRecord};
use crate::{manifest, page, signature};
use jiff::Timestamp;
use platebench_report::{html, traceability};
use platebench_runner::folder::hexadecimal;
use platebench_runner::{Cancel, Clock, Company, Nobody, RunError, RunFolder, rejudge, run_in_company};
use platebench_verdict::record::{Firmware, Overrides};
use platebench_verdict::{RunRecord, Verdict};
use std::fs::{self, File, TryLockError};
use std::path::Path;
use tracing::info;

/// The copy of the plan in a record.
pub(crate) const PLAN: &str = "plan.toml";
/// The folder of the steps' own folders.
pub(crate) const STEPS: &str = "steps";

/// What a step does.
#[derive(Debug, Clone, Copy)]
enum Task<'a> {
    Identity,
    Ask(&'a Ask),
    SelfTest,
    Trust,
    Scenario(&'a Planned),
}

/// Begins the session that `order` describes, or goes on with it where it was cut off, and brings it to its end.
///
/// # Errors
/// [`AcceptError`]; what had ended by then is in the record, and the same call goes on from there.
pub fn conduct(order: &Order, desk: &mut dyn Desk, cancel: &Cancel) -> Result<SessionRecord, AcceptError> {
    let mut session = Session::open(order, desk)?;
    let tasks = tasks(&order.plan);
    if session.record.steps.len() != tasks.len() {
        let message = format!("{} steps, expected {}", session.record.steps.len(), tasks.len());
        return Err(AcceptError::Content { path: order.out.join(FILE), message });
    }
    let is_open = session.record.steps.iter().any(|step| !step.done);
    if is_open && session.record.firmware.is_some() {
        same_firmware(session.record.firmware.as_ref(), &session.introduced()?)?;
    }
    for (index, task) in tasks.iter().enumerate() {
        if session.record.steps.get(index).is_some_and(|step| step.done) {
            continue;
        }
        if cancel.is_cancelled() {
            return Err(AcceptError::Cancelled);
        }
        session.step(index, *task, desk, cancel)?;
    }
    session.close()
}

/// The steps of a plan, in order.
fn tasks(plan: &Plan) -> Vec<Task<'_>> {
    let asks = |when| plan.asks.iter().filter(move |ask| ask.when == when).map(Task::Ask);
    let mut tasks = vec![Task::Identity];
    tasks.extend(asks(When::Before));
    tasks.extend([Task::SelfTest, Task::Trust]);
    tasks.extend(plan.scenarios.iter().map(Task::Scenario));
    tasks.extend(asks(When::After));
    tasks
}

/// The steps of a plan, none of them begun.
pub(crate) fn step_records(plan: &Plan) -> Vec<StepRecord> {
    let described = |task: &Task<'_>| match task {
        Task::Identity => ("identity".to_owned(), "Board and firmware".to_owned(), StepKind::Identity),
        Task::Ask(ask) => (format!("ask-{}", ask.id), ask.question.clone(), StepKind::Ask),
        Task::SelfTest => {
            ("self-test".to_owned(), "The bench's own timing and repeatability".to_owned(), StepKind::SelfTest)
        }
        Task::Trust => {
            ("trust".to_owned(), "How well the scenarios catch faulty controllers".to_owned(), StepKind::Trust)
        }
        Task::Scenario(planned) => {
            let name = planned.scenario.name().replace(['/', '\\'], "-");
            (name, planned.scenario.title.clone(), StepKind::Scenario)
        }
    };
    let numbered = tasks(plan).into_iter().enumerate();
    numbered
        .map(|(number, task)| {
            let (name, title, kind) = described(&task);
            StepRecord::new(format!("{:02}-{name}", number + 1), &title, kind)
        })
        .collect()
}

pub(crate) fn now() -> String {
    Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// A session under way. Nobody else writes into its folder meanwhile.
struct Session<'a> {
    order: &'a Order,
    record: SessionRecord,
    /// Held until the session is let go.
    _lock: File,
}

impl<'a> Session<'a> {
    fn open(order: &'a Order, desk: &mut dyn Desk) -> Result<Self, AcceptError> {
        let folder = &order.out;
        let exists = folder.join(FILE).exists();
        if order.resume && !exists {
            return Err(AcceptError::NoSession(folder.clone()));
        }
        fs::create_dir_all(folder).map_err(AcceptError::io(folder))?;
        let lock = File::open(folder).map_err(AcceptError::io(folder))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(AcceptError::InUse(folder.clone())),
            Err(TryLockError::Error(source)) => return Err(AcceptError::io(folder)(source)),
        }
        durable::remove_provisional(folder)?;
        let now_asked = first_record(order)?;
        let record = if folder.join(FILE).exists() {
            let mut record = SessionRecord::read(folder)?;
            if is_finished(folder, &record) {
                return Err(AcceptError::Finished(folder.clone()));
            }
            unchanged(&record, &now_asked)?;
            evidence_is_there(folder, &record)?;
            let said = &order.who;
            for (there, given) in [
                (&mut record.operator, &said.operator),
                (&mut record.place, &said.place),
                (&mut record.notes, &said.notes),
            ] {
                if there.is_none() {
                    there.clone_from(given);
                }
            }
            record.resumed.push(now());
            info!(folder = %folder.display(), "session goes on");
            record
        } else {
            if fs::read_dir(folder).map_err(AcceptError::io(folder))?.next().is_some() {
                return Err(AcceptError::Taken(folder.clone()));
            }
            let mut record = now_asked;
            for (there, text) in [
                (&mut record.operator, "Who is the operator?"),
                (&mut record.place, "Where is this?"),
                (&mut record.notes, "Notes?"),
            ] {
                if there.is_none()
                    && let Answer::Terminal(said) = desk.ask(&Question { text, kind: AnswerKind::Text })
                    && !said.is_empty()
                {
                    *there = Some(said);
                }
            }
            record
        };
        record.write(folder)?;
        durable::write(&folder.join(PLAN), &order.plan.bytes)?;
        Ok(Self { order, record, _lock: lock })
    }

    /// Does one step.
    fn step(&mut self, index: usize, task: Task<'_>, desk: &mut dyn Desk, cancel: &Cancel) -> Result<(), AcceptError> {
        let Some(begun) = self.record.steps.get_mut(index) else { return Ok(()) };
        begun.attempts.push(Attempt { started: now(), ended: None, broken_off: None });
        let mut step = begun.clone();
        let folder = self.order.out.join(STEPS).join(&step.id);
        if folder.exists() {
            fs::remove_dir_all(&folder).map_err(AcceptError::io(&folder))?;
        }
        self.record.write(&self.order.out)?;
        desk.begun(&step);
        let done = self.perform(task, &folder, &mut step, desk, cancel);
        if let Some(attempt) = step.attempts.last_mut() {
            attempt.ended = Some(now());
            attempt.broken_off = done.as_ref().err().map(ToString::to_string);
        }
        if done.is_ok() {
            if folder.exists() {
                durable::sync_below(&folder)?;
            }
            step.done = true;
            desk.ended(&step);
        }
        let attempts = step.attempts.clone();
        if let Some(stored) = self.record.steps.get_mut(index) {
            // Of an attempt that does not count nothing stays but that it was made.
            if done.is_ok() { *stored = step } else { stored.attempts = attempts }
        }
        self.record.write(&self.order.out)?;
        done
    }

    fn perform(
        &mut self,
        task: Task<'_>,
        folder: &Path,
        step: &mut StepRecord,
        desk: &mut dyn Desk,
        cancel: &Cancel,
    ) -> Result<(), AcceptError> {
        let real_time = matches!(self.order.clock, Clock::RealTime(_));
        match task {
            Task::Identity => {
                let found = self.introduced()?;
                let Firmware { name, version, build, chip } = &found.firmware;
                let board = if may_have_a_board(&self.order.rig) {
                    format!("chip {chip}, number {}", found.unique)
                } else {
                    "no board".to_owned()
                };
                step.reason = Some(format!("{name} {version}, build {build}, {board}"));
                step.verdict = Some(Verdict::Pass);
                self.record.firmware = Some(found);
                Ok(())
            }
            Task::Ask(ask) => asked(ask, &self.order.rig, step, desk, cancel),
            Task::SelfTest => {
                self_test::self_test(&self.order.plan, real_time, folder, step, desk, cancel).map_err(early)
            }
            Task::Trust => self_test::trust(&self.order.plan, folder, step, cancel),
            Task::Scenario(planned) => self.play(planned, folder, step, desk, cancel).map_err(early),
        }
    }

    /// Plays a scenario to the controller and files all that comes of it.
    fn play(
        &self,
        planned: &Planned,
        folder: &Path,
        step: &mut StepRecord,
        desk: &mut dyn Desk,
        cancel: &Cancel,
    ) -> Result<(), AcceptError> {
        let overrides = Overrides { trials: Some(planned.repetitions), ..Overrides::default() };
        let mut scenario = planned.scenario.clone();
        rejudge::apply(&overrides, &mut scenario);
        let rig = &self.order.rig;
        let plan = platebench_runner::Plan {
            scenarios: vec![scenario],
            jobs: self.order.jobs,
            clock: self.order.clock,
            own_clock: rig.has_own_clock(),
            rig: rig.to_string(),
            overrides,
        };
        let run_folder = RunFolder::create(Some(folder)).map_err(RunError::from)?;
        let watch = desk.watch(&plan);
        let company = Company { person: &Nobody, watch: &watch };
        let record =
            run_in_company(&plan, &run_folder, &|| self.connect(), cancel, company, &mut |event| desk.event(&event))?;
        let played = record.rig.firmware.as_ref();
        if let (Some(played), Some(known)) = (played, &self.record.firmware)
            && *played != known.firmware
        {
            return Err(changed("the firmware", &shown_firmware(&known.firmware), &shown_firmware(played)));
        }
        html::write(&record, folder)?;
        traceability::write(&record, folder)?;
        step.run_sha256 = Some(run_sha256(folder)?);
        step.lost = record.lost_a_controller() || record.safe_confirmed == Some(false);
        step.verdict = Some(record.verdict);
        let expectations: Vec<_> = record.scenarios.iter().flat_map(|scenario| &scenario.expectations).collect();
        let passed = expectations.iter().filter(|expectation| expectation.verdict == Verdict::Pass).count();
        let trials: usize = record.scenarios.iter().map(|scenario| scenario.trials.len()).sum();
        step.reason = Some(format!(
            "{passed} of {} expectations met in {trials} trial{}",
            expectations.len(),
            if trials == 1 { "" } else { "s" }
        ));
        Ok(())
    }

    fn connect(&self) -> Result<platebench_rig::AnyLink, platebench_rig::ConnectError> {
        match self.order.clock {
            Clock::Lockstep { .. } => self.order.rig.connect(),
            Clock::RealTime(_) | Clock::OwnPlate => self.order.rig.connect_in_real_time(),
        }
    }

    /// Asks the controller who it is.
    fn introduced(&self) -> Result<FirmwareRecord, AcceptError> {
        let link = self.connect().map_err(RunError::from)?;
        let session = platebench_rig::Session::open(link).map_err(RunError::from)?;
        let identity = *session.identity();
        let name = session.firmware_name();
        session.close();
        let [major, minor, patch] = identity.version;
        Ok(FirmwareRecord {
            firmware: Firmware {
                name,
                version: format!("{major}.{minor}.{patch}"),
                build: hexadecimal(&identity.build),
                chip: format!("{:#010x}", identity.chip),
            },
            unique: hexadecimal(&identity.unique),
            image_sha256: image_sha256(&self.order.rig)?,
        })
    }

    /// Judges the session and seals its record.
    fn close(mut self) -> Result<SessionRecord, AcceptError> {
        let folder = &self.order.out;
        for name in [manifest::FILE, signature::FILE] {
            let path = folder.join(name);
            if path.exists() {
                fs::remove_file(&path).map_err(AcceptError::io(&path))?;
            }
        }
        let runs = runs(folder, &self.record.steps)?;
        let (requirements, verdict) = decide(&self.order.plan.requirements, &self.record.steps, &runs);
        self.record.requirements = requirements;
        self.record.verdict = verdict;
        self.record.complete = true;
        self.record.finished = Some(now());
        self.record.signature = self
            .order
            .key
            .as_ref()
            .map(|key| SignatureRecord { algorithm: "ed25519".to_owned(), public_key: key.public().pem() });
        self.record.write(folder)?;
        let page = page::page(&self.record).into_string();
        durable::write(&folder.join(page::FILE), page.as_bytes())?;
        manifest::write(folder)?;
        if let Some(key) = &self.order.key {
            let path = folder.join(manifest::FILE);
            let manifest = fs::read(&path).map_err(AcceptError::io(&path))?;
            durable::write(&folder.join(signature::FILE), &key.sign(&manifest))?;
        }
        Ok(self.record)
    }
}

/// A run that was ended early is a session that was.
fn early(error: AcceptError) -> AcceptError {
    match error {
        AcceptError::Run(RunError::Cancelled) => AcceptError::Cancelled,
        other => other,
    }
}

fn is_finished(folder: &Path, record: &SessionRecord) -> bool {
    let is_there = |name: &str| folder.join(name).exists();
    record.complete && is_there(manifest::FILE) && (record.signature.is_none() || is_there(signature::FILE))
}

/// The runs of the scenario steps, as they are stored.
fn runs(folder: &Path, steps: &[StepRecord]) -> Result<Vec<(String, RunRecord)>, AcceptError> {
    let played = steps.iter().filter(|step| step.kind == StepKind::Scenario && step.done);
    played
        .map(|step| {
            let run =
                RunRecord::read(&folder.join(STEPS).join(&step.id)).map_err(platebench_runner::RejudgeError::from)?;
            Ok((step.id.clone(), run))
        })
        .collect()
}
