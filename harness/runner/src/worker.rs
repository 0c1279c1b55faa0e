//! Plays and measures trials over one link to a controller.

use crate::configure;
use crate::delay_attribution::measure_trial;
use crate::delay_boundary::scenario_delay_boundary;
use crate::live_tap::{LiveTap, TapWriter};
use crate::operator::Operator;
use crate::plan::{Clock, LinkFactory, RunError, RunPlan};
use crate::trial::{self, TrialResult, TrialSpec};
use crate::{real_plate, real_time};
use platebench_plate::Time;
use platebench_record::{KeepTraces, RunFolder, Telemetry, TrialRecord, to_hex, trace_path};
use platebench_rig::{BoxedLink, CancelToken, FaultInjector, RigError};
use platebench_scenario::Scenario;
use platebench_trace::{Row, TraceError, TraceWriter};
use platebench_verdict::{TrialMeasures, trial_record};
use platebench_wire::{Identity, LawId};
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::Instant;
use tracing::{debug, error, info_span};

const RESULT_QUEUE: usize = 256;

pub(crate) type RigSession = platebench_rig::Session<FaultInjector<BoxedLink>>;

#[derive(Clone, Copy)]
pub(crate) struct RunContext<'a> {
    pub(crate) plan: &'a RunPlan,
    pub(crate) laws: &'a [LawId],
    /// Longest loop delay at which the law settles, one cell per scenario.
    pub(crate) delay_boundaries: &'a [OnceLock<Option<Time>>],
    pub(crate) folder: &'a RunFolder,
    pub(crate) connect: &'a LinkFactory<'a>,
    pub(crate) identity: Identity,
    pub(crate) cancel: &'a CancelToken,
    pub(crate) operator: &'a dyn Operator,
    pub(crate) live_tap: &'a LiveTap,
    pub(crate) trials_with_rows: usize,
    pub(crate) safe_unconfirmed: &'a AtomicBool,
    /// Set once no further trial may start. Trials in progress end normally.
    pub(crate) stop: &'a AtomicBool,
}

pub(crate) fn close_session(session: &mut Option<RigSession>, unconfirmed: &AtomicBool) {
    let Some(session) = session.take() else { return };
    // A panic of the link counts as a missing confirmation of 0 V.
    let confirmed = catch_unwind(AssertUnwindSafe(|| session.close())).unwrap_or(false);
    unconfirmed.fetch_or(!confirmed, Ordering::Relaxed);
}

#[derive(Clone)]
pub(crate) struct TrialTask {
    pub(crate) scenario: usize,
    pub(crate) trials: Range<u32>,
}

/// One task per trial, or one for all if the controller's history is part of the experiment.
pub(crate) fn trial_tasks(scenario: usize, keeps_controller: bool, trials: Range<u32>) -> Vec<TrialTask> {
    if keeps_controller {
        return vec![TrialTask { scenario, trials }];
    }
    trials.map(|index| TrialTask { scenario, trials: index..index + 1 }).collect()
}

pub(crate) struct CompletedTrial {
    pub(crate) measures: TrialMeasures,
    pub(crate) record: TrialRecord,
    /// Empty unless the report draws the trial.
    pub(crate) rows: Vec<Row>,
}

pub(crate) enum Progress {
    Ready,
    Started(usize),
    Completed(usize, Box<CompletedTrial>),
}

pub(crate) type ResultSender = mpsc::SyncSender<Result<Progress, RunError>>;

/// With `fail_fast` the channel has no capacity, so a send waits until earlier results are handled.
pub(crate) fn result_channel(fail_fast: bool) -> (ResultSender, mpsc::Receiver<Result<Progress, RunError>>) {
    mpsc::sync_channel(if fail_fast { 0 } else { RESULT_QUEUE })
}

pub(crate) struct WorkQueue<'a> {
    pub(crate) run: RunContext<'a>,
    pub(crate) tasks: &'a [TrialTask],
    pub(crate) next: AtomicUsize,
}

impl WorkQueue<'_> {
    pub(crate) fn run_worker(&self, session: &mut Option<RigSession>, results: &ResultSender) {
        while self.may_start(results) {
            let Some(task) = self.tasks.get(self.next.fetch_add(1, Ordering::Relaxed)) else { break };
            if task.trials.start == 0 && results.send(Ok(Progress::Started(task.scenario))).is_err() {
                break;
            }
            let first = task.trials.start;
            let mut trials = task.trials.clone();
            if !trials.all(|index| {
                (index == first || self.may_start(results))
                    && self.play_and_send(session, task.scenario, index, results)
            }) {
                break;
            }
        }
    }

    /// With `--fail-fast`, waits until the earlier results of this worker are judged.
    fn may_start(&self, results: &ResultSender) -> bool {
        let is_judged = !self.run.plan.overrides.fail_fast || results.send(Ok(Progress::Ready)).is_ok();
        is_judged && !self.run.cancel.is_cancelled() && !self.run.stop.load(Ordering::Relaxed)
    }

    /// Returns false if the worker must end.
    fn play_and_send(
        &self,
        session: &mut Option<RigSession>,
        scenario: usize,
        index: u32,
        results: &ResultSender,
    ) -> bool {
        let played = catch_unwind(AssertUnwindSafe(|| self.play_trial(session, scenario, index)));
        let result = match played {
            Ok(Ok(Some(done))) => Ok(Progress::Completed(scenario, Box::new(done))),
            Ok(Ok(None)) => return false,
            Ok(Err(error)) => Err(error),
            Err(panic) => Err(RunError::Internal(panic_message(panic.as_ref()))),
        };
        let is_over = result.is_err();
        if is_over {
            // The error ends the run, so 0 V is requested first.
            close_session(session, self.run.safe_unconfirmed);
        }
        results.send(result).is_ok() && !is_over
    }

    fn spec<'a>(&self, scenario: &'a Scenario, law: LawId, index: u32) -> TrialSpec<'a> {
        let wire_time = self.run.plan.clock == Clock::Lockstep { wire_time: true };
        TrialSpec { wire_time, own_clock: self.run.plan.own_clock, ..TrialSpec::new(scenario, law, index) }
    }

    fn play_on_clock(
        &self,
        session: &mut RigSession,
        spec: &TrialSpec<'_>,
        tap: Option<&mut TapWriter>,
    ) -> Result<Option<TrialResult>, RunError> {
        match self.run.plan.clock {
            Clock::RealPlate => Ok(real_plate::play(session, spec, self.run.operator, self.run.cancel)?),
            Clock::Lockstep { .. } => Ok(trial::play(session, spec, self.run.cancel, tap)),
            Clock::RealTime(time_base) => Ok(real_time::play(session, spec, time_base, self.run.cancel, tap)),
        }
    }

    /// Plays the scenes between trials and returns what they show about the controller. `None` if the
    /// run was cancelled.
    fn play_between(
        &self,
        session: &mut RigSession,
        scenario: &Scenario,
        index: u32,
    ) -> Result<Option<Telemetry>, RunError> {
        let mut scenes = Telemetry::default();
        for scene in scenario.between.iter().filter(|_| index > 0) {
            let law = configure::law(scene).map_err(|unknown| RunError::Scenario(Box::new(unknown)))?;
            let spec = TrialSpec { continues: true, ..self.spec(scene, law, index) };
            let Some(played) = self.play_on_clock(session, &spec, None)? else { return Ok(None) };
            if let Some(refused @ RigError::ConfigurationRejected(_)) = played.link_error {
                return Err(refused.into());
            }
            scenes.include_scene(played.telemetry);
        }
        Ok(Some(scenes))
    }

    /// Fails if the controller is not the one with which the run began.
    fn connect_session(&self) -> Result<RigSession, RunError> {
        let session = RigSession::open(FaultInjector::new((self.run.connect)()?))?;
        let (found, expected) = (*session.identity(), self.run.identity);
        if found == expected {
            return Ok(session);
        }
        close_session(&mut Some(session), self.run.safe_unconfirmed);
        Err(RunError::DifferentController { found: controller_name(&found), expected: controller_name(&expected) })
    }

    fn play_trial(
        &self,
        session: &mut Option<RigSession>,
        number: usize,
        index: u32,
    ) -> Result<Option<CompletedTrial>, RunError> {
        let (Some(scenario), Some(&law)) = (self.run.plan.scenarios.get(number), self.run.laws.get(number)) else {
            return Ok(None);
        };
        let _span = info_span!("trial", scenario = %scenario.file, index).entered();
        let started = Instant::now();
        if !scenario.between.is_empty() && index == 0 {
            // The first trial needs a controller without a history.
            close_session(session, self.run.safe_unconfirmed);
        }
        let open = match session {
            Some(open) => open,
            None => session.insert(self.connect_session()?),
        };
        let Some(scenes) = self.play_between(open, scenario, index)? else { return Ok(None) };
        let mut tap = self.run.live_tap.acquire(number, index);
        let continues = index > 0 && scenario.keeps_controller();
        let spec = TrialSpec { continues, ..self.spec(scenario, law, index) };
        let played = self.play_on_clock(open, &spec, tap.tap())?;
        drop(tap);
        let Some(mut played) = played else { return Ok(None) };
        played.telemetry.include_scene(scenes);
        if let Some(timing) = &mut played.telemetry.timing {
            let boundary = self.run.delay_boundaries.get(number);
            let boundary = boundary.and_then(|cell| *cell.get_or_init(|| scenario_delay_boundary(scenario, law)));
            timing.loop_delay_budget_us = boundary.map(|boundary| boundary.seconds() * 1e6);
        }
        if let Some(refused @ RigError::ConfigurationRejected(_)) = played.link_error {
            return Err(refused.into());
        }
        let trace = trace_path(scenario.name(), index);
        let path = self.run.folder.path().join(&trace);
        let measures = measure_trial(scenario, law, index, &played.trace_rows, &played.telemetry);
        let is_stored = match self.run.plan.overrides.keep_traces {
            KeepTraces::All | KeepTraces::Worst(_) => true,
            KeepTraces::Failing => measures.margin(&scenario.expectations) < 0.0,
            KeepTraces::None => false,
        };
        let hash = is_stored.then(|| write_trace(&path, &played.trace_rows)).transpose()?;
        let wall_ms = started.elapsed().as_secs_f64() * 1e3;
        debug!(rows = played.trace_rows.len(), wall_ms, measures = ?measures.measures, "trial measured");
        let mut record = trial_record(scenario, &measures, played.telemetry, trace, Some(wall_ms));
        record.sha256 = hash.as_ref().map(|hash| to_hex(hash));
        if let Some(lost) = played.link_error {
            error!(error = %lost, "controller lost");
            close_session(session, self.run.safe_unconfirmed);
        }
        let is_drawn = (index as usize) < self.run.trials_with_rows;
        let rows = if is_drawn { played.trace_rows } else { Vec::new() };
        Ok(Some(CompletedTrial { measures, record, rows }))
    }
}

fn write_trace(path: &Path, rows: &[Row]) -> Result<[u8; 32], TraceError> {
    let mut writer = TraceWriter::create(path)?;
    rows.iter().try_for_each(|row| writer.write(row))?;
    writer.finish()
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("no message").to_owned()
}

fn controller_name(identity: &Identity) -> String {
    let [major, minor, patch] = identity.version;
    let [build, unique] = [&identity.build[..], &identity.unique[..]].map(to_hex);
    format!("{} {major}.{minor}.{patch}, build {build}, number {unique}", platebench_rig::printable_name(identity))
}
