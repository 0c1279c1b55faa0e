//! Takes trials of a run from a queue, plays and measures them, and stores their traces.

use crate::delay_attribution::measure_trial;
use crate::delay_boundary::scenario_delay_boundary;
use crate::executor::Executor;
use crate::live_tap::LiveTap;
use crate::plan::{RunError, RunPlan};
use platebench_model::record::{KeepTraces, RunFolder, TrialRecord, to_hex, trace_path};
use platebench_model::trace::{Row, TraceError, TraceWriter};
use platebench_plate::Time;
use platebench_rig::CancelToken;
use platebench_verdict::{TrialMeasures, trial_record};
use platebench_wire::LawId;
use std::convert::Infallible;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{OnceLock, mpsc};
use std::time::Instant;
use tracing::{debug, info_span};

const RESULT_QUEUE: usize = 256;

#[derive(Clone, Copy)]
pub(crate) struct RunContext<'a> {
    pub(crate) plan: &'a RunPlan,
    pub(crate) laws: &'a [LawId],
    /// Longest loop delay at which the law settles, one cell per scenario.
    pub(crate) delay_boundaries: &'a [OnceLock<Option<Time>>],
    pub(crate) folder: &'a RunFolder,
    pub(crate) cancel: &'a CancelToken,
    pub(crate) live_tap: &'a LiveTap,
    pub(crate) trials_with_rows: usize,
    /// Set once no further trial may start. Trials in progress end normally.
    pub(crate) stop: &'a AtomicBool,
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
    Started(usize),
    /// The worker waits until the receiver drops the sender, if there is one.
    Completed(usize, Box<CompletedTrial>, Option<mpsc::Sender<Infallible>>),
}

pub(crate) type ResultSender = mpsc::SyncSender<Result<Progress, RunError>>;

pub(crate) fn result_channel() -> (ResultSender, mpsc::Receiver<Result<Progress, RunError>>) {
    mpsc::sync_channel(RESULT_QUEUE)
}

pub(crate) struct WorkQueue<'a> {
    pub(crate) run: RunContext<'a>,
    pub(crate) tasks: &'a [TrialTask],
    pub(crate) next: AtomicUsize,
}

impl WorkQueue<'_> {
    pub(crate) fn run_worker(&self, executor: &mut Executor<'_>, results: &ResultSender) {
        while self.may_start() {
            let Some(task) = self.tasks.get(self.next.fetch_add(1, Ordering::Relaxed)) else { break };
            if task.trials.start == 0 && results.send(Ok(Progress::Started(task.scenario))).is_err() {
                break;
            }
            let first = task.trials.start;
            let mut trials = task.trials.clone();
            if !trials.all(|index| {
                (index == first || self.may_start()) && self.play_and_send(executor, task.scenario, index, results)
            }) {
                break;
            }
        }
    }

    fn may_start(&self) -> bool {
        !self.run.cancel.is_cancelled() && !self.run.stop.load(Ordering::Relaxed)
    }

    /// Returns false if the worker must end. With `--fail-fast`, waits until the result is judged.
    fn play_and_send(&self, executor: &mut Executor<'_>, scenario: usize, index: u32, results: &ResultSender) -> bool {
        let played = catch_unwind(AssertUnwindSafe(|| self.play_trial(executor, scenario, index)));
        let error = match played {
            Ok(Ok(Some(done))) => {
                let (handled, until_handled) = mpsc::channel();
                let handled = self.run.plan.overrides.fail_fast.then_some(handled);
                let is_sent = results.send(Ok(Progress::Completed(scenario, Box::new(done), handled))).is_ok();
                // The receiver sends nothing. The wait ends when it drops the sender.
                let _ = until_handled.recv();
                return is_sent;
            }
            Ok(Ok(None)) => return false,
            Ok(Err(error)) => error,
            Err(panic) => RunError::Internal(panic_message(panic.as_ref())),
        };
        // The error ends the run, so 0 V is requested first.
        executor.close();
        let _ = results.send(Err(error));
        false
    }

    fn play_trial(
        &self,
        executor: &mut Executor<'_>,
        number: usize,
        index: u32,
    ) -> Result<Option<CompletedTrial>, RunError> {
        let (Some(scenario), Some(&law)) = (self.run.plan.scenarios.get(number), self.run.laws.get(number)) else {
            return Ok(None);
        };
        let _span = info_span!("trial", scenario = %scenario.file, index).entered();
        let started = Instant::now();
        let mut tap = self.run.live_tap.acquire(number, index);
        let played = executor.play(scenario, law, index, tap.tap())?;
        drop(tap);
        let Some(mut played) = played else { return Ok(None) };
        if let Some(timing) = &mut played.telemetry.timing {
            let boundary = self.run.delay_boundaries.get(number);
            let boundary = boundary.and_then(|cell| *cell.get_or_init(|| scenario_delay_boundary(scenario, law)));
            timing.loop_delay_budget_us = boundary.map(|boundary| boundary.seconds() * 1e6);
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
