//! All trials of all scenarios, over several workers, in an order that no result depends on.

use crate::configure;
use crate::event::Event;
use crate::folder::{FolderError, RunFolder, hexadecimal, sha256, trace_file};
use crate::measured::{delay_budget, measured};
use crate::real_plate::{self, Nobody, Person};
use crate::real_time::{self, Pace, Pacing};
use crate::trend;
use crate::trial::{self, Order, Patience};
use crate::watch::Watch;
use platebench_rig::{AnyLink, ConnectError, Faulty, RigError};
use platebench_scenario::{Diagnostic, Scenario};
use platebench_trace::{Row, TraceError, Writer};
use platebench_verdict::judge::trial_record;
use platebench_verdict::record::{Firmware, Host, InputRecord, ModelChoice, Overrides, RigRecord, Tool};
use platebench_verdict::{Decision, RunRecord, ScenarioRecord, TrialMeasures, TrialRecord, Verdict, judge, sequential};
use platebench_wire::{Identity, LawId, capabilities};
use std::cmp::Reverse;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Instant;
use tracing::{debug, error, info, info_span};

/// Makes a new link to a controller; called once per worker, and again where a controller was lost.
pub type Connect<'a> = dyn Fn() -> Result<AnyLink, ConnectError> + Send + Sync + 'a;

/// A controller on any rig, with a line that may be harmed.
type Session = platebench_rig::Session<Faulty<AnyLink>>;

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What is played, with the overrides already applied.
    pub scenarios: Vec<Scenario>,
    /// How many trials may run at once.
    pub jobs: usize,
    /// How time passes for the plate.
    pub clock: Clock,
    /// True where the controller has a clock of its own, which does not wait for the plate's.
    pub own_clock: bool,
    /// The rig as named on the command line.
    pub rig: String,
    /// Options of the command line that changed the scenarios.
    pub overrides: Overrides,
}

/// How time passes for the plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Clock {
    /// It waits while a sample travels and the controller computes.
    Lockstep {
        /// True where the time that the rig takes acts on the plate as loop delay.
        wire_time: bool,
    },
    /// It does not wait.
    RealTime(Pace),
    /// There is no plate here: the controller drives a real one, by its own clock.
    OwnPlate,
}

impl Clock {
    /// The name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lockstep { .. } => "lockstep",
            Self::RealTime(_) => "real-time",
            Self::OwnPlate => "real-plate",
        }
    }
}

/// A switch that ends a run early, from any thread.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Ends the run: trials that go on are driven to 0 V and given up.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// True once the run is to end.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

impl Patience for Cancel {
    fn is_over(&self) -> bool {
        self.is_cancelled()
    }
}

/// Why there is no record.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A scenario asks for what the controller does not have.
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    /// There is no line to a controller.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// The controller does not answer.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The record names one controller.
    #[error("{found} answers now, the run began with {expected}: expected the same controller until its end")]
    OtherController {
        /// Who answers.
        found: String,
        /// Who is in the record.
        expected: String,
    },
    /// The controller has no timer of its own to pace the plate by.
    #[error("{0} does not say that it can pace itself, expected --pacing bench")]
    NoPace(String),
    /// The controller has no plate of its own.
    #[error("{0} does not say that it drives a plate of its own, expected --plate-mode emulated")]
    NoPlate(String),
    /// The run folder cannot be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A trace cannot be written.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The run was ended early; what was whole by then is in the run folder.
    #[error("the run was ended early")]
    Cancelled,
    /// A fault of the bench itself.
    #[error("the bench has a fault of its own, please report it: {0}")]
    Bench(String),
}

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

/// Who is there while a run goes on.
#[derive(Clone, Copy)]
pub struct Company<'a> {
    /// Somebody at the plate, where that is a real one.
    pub person: &'a dyn Person,
    /// Somebody who looks on: of trials that go on at once at one of them.
    pub watch: &'a Watch,
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

/// Drives the plate to 0 V and lets go of its controller.
fn end(session: &mut Option<Session>, unconfirmed: &AtomicBool) {
    let Some(session) = session.take() else { return };
    // A link that panics has confirmed nothing.
    let confirmed = catch_unwind(AssertUnwindSafe(|| session.close())).unwrap_or(false);
    unconfirmed.fetch_or(!confirmed, Ordering::Relaxed);
}

/// A run and what all its parts share.
#[derive(Clone, Copy)]
struct Run<'a> {
    plan: &'a Plan,
    laws: &'a [LawId],
    folder: &'a RunFolder,
    connect: &'a Connect<'a>,
    /// Who is in the record.
    identity: Identity,
    cancel: &'a Cancel,
    company: Company<'a>,
    /// Set where a controller was let go that did not confirm 0 V.
    unconfirmed: &'a AtomicBool,
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

/// One trial that is to be played.
#[derive(Clone, Copy)]
struct Task {
    scenario: usize,
    index: u32,
}

fn trials_of(scenario: usize, from: u32, to: u32) -> impl Iterator<Item = Task> {
    (from..to).map(move |index| Task { scenario, index })
}

/// One trial that was played.
pub(crate) struct Done {
    pub(crate) measures: TrialMeasures,
    pub(crate) record: TrialRecord,
}

enum Progress {
    Started(usize),
    Done(usize, Box<Done>),
}

/// What all workers share.
struct Work<'a> {
    run: Run<'a>,
    tasks: &'a [Task],
    next: AtomicUsize,
}

impl Work<'_> {
    /// Plays trials until none is left, each worker over a link of its own.
    fn worker(&self, session: &mut Option<Session>, results: &mpsc::Sender<Result<Progress, RunError>>) {
        while !self.run.cancel.is_cancelled() {
            let Some(&task) = self.tasks.get(self.next.fetch_add(1, Ordering::Relaxed)) else { break };
            if task.index == 0 && results.send(Ok(Progress::Started(task.scenario))).is_err() {
                break;
            }
            let played = catch_unwind(AssertUnwindSafe(|| self.play(session, task)));
            let result = match played {
                Ok(Ok(Some(done))) => Ok(Progress::Done(task.scenario, Box::new(done))),
                Ok(Ok(None)) => break,
                Ok(Err(error)) => Err(error),
                Err(panic) => Err(RunError::Bench(panic_message(panic.as_ref()))),
            };
            let is_over = result.is_err();
            if is_over {
                // At once, and not once the others have come to their end.
                end(session, self.run.unconfirmed);
            }
            if results.send(result).is_err() || is_over {
                break;
            }
        }
    }

    /// A new link to the controller that the record names.
    fn connected(&self) -> Result<Session, RunError> {
        let session = Session::open(Faulty::new((self.run.connect)()?))?;
        let (found, expected) = (*session.identity(), self.run.identity);
        if found == expected {
            return Ok(session);
        }
        end(&mut Some(session), self.run.unconfirmed);
        Err(RunError::OtherController { found: who(&found), expected: who(&expected) })
    }

    /// Plays and measures one trial. `None` where it was given up.
    fn play(&self, session: &mut Option<Session>, task: Task) -> Result<Option<Done>, RunError> {
        let (Some(scenario), Some(&law)) =
            (self.run.plan.scenarios.get(task.scenario), self.run.laws.get(task.scenario))
        else {
            return Ok(None);
        };
        let _span = info_span!("trial", scenario = %scenario.file, index = task.index).entered();
        let started = Instant::now();
        let open = match session {
            Some(open) => open,
            None => session.insert(self.connected()?),
        };
        let wire_time = self.run.plan.clock == Clock::Lockstep { wire_time: true };
        let order = Order { scenario, law, index: task.index, wire_time, own_clock: self.run.plan.own_clock };
        let mut lent = self.run.company.watch.lend(task.scenario, task.index);
        let played = match self.run.plan.clock {
            Clock::OwnPlate => real_plate::play(open, &order, self.run.company.person, self.run.cancel)?,
            Clock::Lockstep { .. } => trial::play_watched(open, &order, self.run.cancel, lent.tap()),
            Clock::RealTime(pace) => real_time::play_watched(open, &order, pace, self.run.cancel, lent.tap()),
        };
        drop(lent);
        let Some(mut played) = played else { return Ok(None) };
        if let Some(timing) = &mut played.telemetry.timing {
            timing.loop_delay_budget_us = delay_budget(scenario, law).map(|budget| budget.seconds() * 1e6);
        }
        if let Some(refused @ RigError::Refused(_)) = played.lost {
            return Err(refused.into());
        }
        let trace = trace_file(scenario.name(), task.index);
        let path = self.run.folder.path().join(&trace);
        write_trace(&path, &played.rows)?;
        let measures = measured(scenario, law, task.index, &played.rows, &played.telemetry);
        let wall_ms = started.elapsed().as_secs_f64() * 1e3;
        debug!(rows = played.rows.len(), wall_ms, measures = ?measures.measures, "trial measured");
        let mut record = trial_record(scenario, &measures, trace, Some(wall_ms));
        let bytes = fs::read(&path).map_err(|source| TraceError::Io { path, source })?;
        record.sha256 = Some(sha256(&bytes));
        if let Some(lost) = played.lost {
            error!(error = %lost, "controller lost");
            // The next trial starts over a new link.
            end(session, self.run.unconfirmed);
        }
        Ok(Some(Done { measures, record }))
    }
}

fn write_trace(path: &Path, rows: &[Row]) -> Result<(), TraceError> {
    let mut writer = Writer::create(path)?;
    rows.iter().try_for_each(|row| writer.write(row))?;
    writer.finish()
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("no message").to_owned()
}

/// A controller by what tells it from others.
fn who(identity: &Identity) -> String {
    let [major, minor, patch] = identity.version;
    let [build, unique] = [&identity.build[..], &identity.unique[..]].map(hexadecimal);
    format!("{} {major}.{minor}.{patch}, build {build}, number {unique}", platebench_rig::printable_name(identity))
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
