//! Plays the trials of a run on several workers, judges each scenario and stores the traces.

use crate::delay_boundary::{measure_trial, scenario_delay_boundary};
use crate::executor::Executor;
use crate::live_tap::LiveTap;
use crate::plan::RunError;
use crate::run_recorder::RunRecorder;
use crate::workers::{Emit, run_workers};
use platebench_model::record::{
    Event, FolderError, KeepTraces, Overrides, RunFolder, TrialRecord, Verdict, defmt_path, to_hex, trace_path,
};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{AtPath as _, Row, TraceError, TraceWriter};
use platebench_plate::Time;
use platebench_rig::CancelToken;
use platebench_verdict::{
    Judgement, SequentialDecision, TrialMeasures, judge, judge_at_time_limit, judge_sequentially, trial_record,
};
use platebench_wire::LawId;
use std::borrow::Cow;
use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::io::Write as _;
use std::ops::{ControlFlow, Range};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};
use tracing::{debug, info, info_span};

/// A scenario that applies to the controller.
pub(crate) struct SelectedScenario<'a> {
    pub(crate) scenario: Cow<'a, Scenario>,
    pub(crate) law: LawId,
}

pub(crate) struct RunPlayer<'a> {
    overrides: &'a Overrides,
    folder: &'a RunFolder,
    cancel: &'a CancelToken,
    live_tap: &'a LiveTap,
    /// The number of first trials of each scenario whose rows the sink receives.
    trials_with_rows: usize,
    scenarios: Vec<ScenarioPlay<'a>>,
    /// `--fail-fast` sets it. No further trial starts then, and trials in progress end normally.
    stop: AtomicBool,
    recorder: Mutex<RunRecorder>,
}

struct ScenarioPlay<'a> {
    scenario: &'a Scenario,
    law: LawId,
    /// Longest loop delay at which the law settles.
    delay_boundary: OnceLock<Option<Time>>,
    played: Mutex<PlayedTrials>,
}

/// Played trials in order of completion. The next interim look needs `trials_until_look` trials.
struct PlayedTrials {
    measures: Vec<TrialMeasures>,
    records: Vec<TrialRecord>,
    trials_until_look: u32,
    is_judged: bool,
    /// Wall time that the time limit of the scenario leaves for further looks.
    time_left: Option<Duration>,
    /// End of `time_left`. Set from the first trial of a look on, so that the scenarios that are
    /// played between two looks take no time from this one.
    deadline: Option<Instant>,
    running: usize,
    /// True if the time limit ended a trial.
    is_timed_out: bool,
}

struct TrialTask {
    scenario: usize,
    trials: Range<u32>,
}

impl<'a> RunPlayer<'a> {
    pub(crate) fn new(
        overrides: &'a Overrides,
        selected: &'a [SelectedScenario<'a>],
        folder: &'a RunFolder,
        cancel: &'a CancelToken,
        live_tap: &'a LiveTap,
        trials_with_rows: usize,
        recorder: RunRecorder,
    ) -> Self {
        let scenarios = selected.iter().map(|selected| ScenarioPlay::new(&selected.scenario, selected.law));
        let (scenarios, stop, recorder) = (scenarios.collect(), AtomicBool::new(false), Mutex::new(recorder));
        Self { overrides, folder, cancel, live_tap, trials_with_rows, scenarios, stop, recorder }
    }

    /// Plays until every scenario is judged, or `--fail-fast` stops the run.
    ///
    /// The thread of the caller receives the events, so that a worker requests 0 V although the output is blocked.
    pub(crate) fn play(&self, executors: &mut [Executor<'_>], on_event: &mut dyn FnMut(Event)) -> Result<(), RunError> {
        let mut sink = |event| {
            on_event(event);
            Ok(ControlFlow::Continue(()))
        };
        loop {
            // First all scenarios reach their first look. Then the undecided scenarios continue.
            let mut tasks: Vec<TrialTask> =
                self.scenarios.iter().enumerate().flat_map(|(number, play)| play.tasks(number)).collect();
            if tasks.is_empty() || self.stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            // Long trials come first, so that no worker ends long after the others.
            tasks.sort_by_key(|task| Reverse(self.scenarios.get(task.scenario).map(|play| play.scenario.duration)));
            let next = AtomicUsize::new(0);
            let source = || self.may_start().then(|| tasks.get(next.fetch_add(1, Ordering::Relaxed))).flatten();
            let workers = executors.iter_mut().take(tasks.len());
            run_workers(workers, source, |executor, task, emit| self.play_task(executor, task, emit), &mut sink)?;
            if self.cancel.is_cancelled() {
                return Err(RunError::Cancelled);
            }
        }
    }

    /// After a run without an error, judges the scenarios that `--fail-fast` stopped early, by the
    /// trials that were played.
    pub(crate) fn finish(self, is_played: bool, on_event: &mut dyn FnMut(Event)) -> RunRecorder {
        let is_stopped = self.stop.into_inner() && is_played;
        let mut recorder = self.recorder.into_inner().unwrap_or_else(PoisonError::into_inner);
        for (number, play) in self.scenarios.into_iter().enumerate().filter(|_| is_stopped) {
            let played = play.played.into_inner().unwrap_or_else(PoisonError::into_inner);
            if !played.is_judged {
                let judgement = judge(play.scenario, &played.measures);
                let event = recorder.finish_scenario(number, play.scenario, judgement, played.records, None);
                event.into_iter().for_each(&mut *on_event);
            }
        }
        recorder
    }

    fn recorder(&self) -> MutexGuard<'_, RunRecorder> {
        self.recorder.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn may_start(&self) -> bool {
        !self.cancel.is_cancelled() && !self.stop.load(Ordering::Relaxed)
    }

    fn play_task(
        &self,
        executor: &mut Executor<'_>,
        task: &TrialTask,
        emit: &mut Emit<'_, Event>,
    ) -> Result<(), RunError> {
        let Some(play) = self.scenarios.get(task.scenario) else { return Ok(()) };
        if task.trials.start == 0 {
            let (scenario, trials) = (play.scenario.file.clone(), play.scenario.trials.count);
            emit(Event::ScenarioStarted { scenario, trials });
        }
        for index in task.trials.clone() {
            if index > task.trials.start && !self.may_start() {
                break;
            }
            let played = catch_unwind(AssertUnwindSafe(|| self.play_trial(executor, task.scenario, play, index, emit)));
            let error = match played {
                Ok(Ok(true)) => continue,
                Ok(Ok(false)) => break,
                Ok(Err(error)) => error,
                Err(panic) => RunError::Internal(panic_message(panic.as_ref())),
            };
            // The error ends the run, so 0 V is requested first and the other trials end early.
            executor.close();
            self.cancel.cancel();
            return Err(error);
        }
        Ok(())
    }

    /// Plays, measures, stores and judges. Returns false if the trial was cancelled, or if the time
    /// limit of the scenario ended it.
    fn play_trial(
        &self,
        executor: &mut Executor<'_>,
        number: usize,
        play: &ScenarioPlay<'_>,
        index: u32,
        emit: &mut Emit<'_, Event>,
    ) -> Result<bool, RunError> {
        let ScenarioPlay { scenario, law, .. } = *play;
        let span = info_span!("trial", scenario = %scenario.file, index).entered();
        let started = Instant::now();
        let Some(cancel) = play.lock_trials().start_trial(self.cancel) else { return Ok(false) };
        executor.set_cancel(&cancel);
        let mut tap = self.live_tap.acquire(number, index);
        let played = executor.play(scenario, law, index, tap.tap())?;
        drop(tap);
        let Some(mut played) = played else {
            let mut trials = play.lock_trials();
            trials.end_trial();
            if !self.cancel.is_cancelled() {
                trials.is_timed_out = true;
                self.judge_at_time_limit(number, scenario, &mut trials, emit)?;
            }
            return Ok(false);
        };
        if let Some(timing) = &mut played.telemetry.timing {
            let boundary = *play.delay_boundary.get_or_init(|| scenario_delay_boundary(scenario, law));
            timing.loop_delay_budget_us = boundary.map(|boundary| boundary.seconds() * 1e6);
        }
        let trace = trace_path(scenario.name(), index);
        if let Some(frames) = played.telemetry.defmt_frames.take() {
            write_frames(self.folder, &defmt_path(&trace), &frames)?;
        }
        let measures = measure_trial(scenario, law, index, &played.trace_rows, &played.telemetry);
        let is_stored = match self.overrides.keep_traces {
            KeepTraces::All | KeepTraces::Worst(_) => true,
            KeepTraces::Failing => measures.margin(&scenario.expectations) < 0.0,
            KeepTraces::None => false,
        };
        let hash = is_stored.then(|| write_trace(self.folder, &trace, &played.trace_rows)).transpose()?;
        let wall_ms = started.elapsed().as_secs_f64() * 1e3;
        debug!(rows = played.trace_rows.len(), wall_ms, measures = ?measures.measures, "trial measured");
        let mut record = trial_record(scenario, &measures, played.telemetry, trace, Some(wall_ms));
        record.sha256 = hash.as_ref().map(|hash| to_hex(hash));
        drop(span);
        let is_drawn = (index as usize) < self.trials_with_rows;
        let rows = if is_drawn { played.trace_rows } else { Vec::new() };
        // Locked until the events are sent, so that the judgement follows its trials. The worker
        // judges, so that it knows before its next trial whether `--fail-fast` stops the run.
        let mut trials = play.lock_trials();
        trials.end_trial();
        trials.measures.push(measures);
        trials.records.push(record.clone());
        let event = self.recorder().add_trial(number, record, rows)?;
        event.map(&mut *emit);
        if trials.is_timed_out {
            self.judge_at_time_limit(number, scenario, &mut trials, emit)?;
            return Ok(false);
        }
        if trials.records.len() < trials.trials_until_look as usize {
            return Ok(true);
        }
        match judge_sequentially(scenario, &trials.measures) {
            SequentialDecision::Continue { trials: next } => {
                info!(scenario = %scenario.file, played = trials.trials_until_look, next, "not decided yet");
                trials.trials_until_look = next;
            }
            SequentialDecision::Stop(judgement) => {
                self.finish_scenario(number, scenario, &mut trials, judgement, None, emit)?;
            }
        }
        Ok(true)
    }

    /// Judges the trials that were played. Does nothing while other trials of the scenario run.
    fn judge_at_time_limit(
        &self,
        number: usize,
        scenario: &Scenario,
        trials: &mut PlayedTrials,
        emit: &mut Emit<'_, Event>,
    ) -> Result<(), RunError> {
        if trials.running > 0 {
            return Ok(());
        }
        let judgement = judge_at_time_limit(scenario, &trials.measures, scenario.timeout_s);
        self.finish_scenario(number, scenario, trials, judgement, scenario.timeout_s, emit)
    }

    fn finish_scenario(
        &self,
        number: usize,
        scenario: &Scenario,
        trials: &mut PlayedTrials,
        judgement: Judgement,
        time_limit_s: Option<f64>,
        emit: &mut Emit<'_, Event>,
    ) -> Result<(), RunError> {
        trials.is_judged = true;
        let mut records = std::mem::take(&mut trials.records);
        if let KeepTraces::Worst(count) = self.overrides.keep_traces {
            keep_worst(self.folder, scenario, &trials.measures, count, &mut records)?;
        }
        if self.overrides.fail_fast && judgement.verdict == Verdict::Fail {
            self.stop.store(true, Ordering::Relaxed);
        }
        info!(scenario = %scenario.file, verdict = %judgement.verdict, "scenario judged");
        let event = self.recorder().finish_scenario(number, scenario, judgement, records, time_limit_s);
        event.map(emit);
        Ok(())
    }
}

impl PlayedTrials {
    /// Adds the time limit to `cancel`. `None` if the scenario plays no further trial.
    fn start_trial(&mut self, cancel: &CancelToken) -> Option<CancelToken> {
        if self.is_judged || self.is_timed_out {
            return None;
        }
        self.running += 1;
        if self.deadline.is_none() {
            self.deadline = self.time_left.map(|left| Instant::now() + left);
        }
        Some(cancel.with_deadline(self.deadline))
    }

    fn end_trial(&mut self) {
        self.running -= 1;
        self.time_left = self.deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
    }
}

impl<'a> ScenarioPlay<'a> {
    fn new(scenario: &'a Scenario, law: LawId) -> Self {
        let trials_until_look = match judge_sequentially(scenario, &[]) {
            SequentialDecision::Continue { trials } => trials,
            SequentialDecision::Stop(_) => 0,
        };
        let played = PlayedTrials {
            measures: Vec::new(),
            records: Vec::new(),
            trials_until_look,
            is_judged: false,
            time_left: scenario.timeout_s.map(Duration::from_secs_f64),
            deadline: None,
            running: 0,
            is_timed_out: false,
        };
        Self { scenario, law, delay_boundary: OnceLock::new(), played: Mutex::new(played) }
    }

    fn lock_trials(&self) -> MutexGuard<'_, PlayedTrials> {
        self.played.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the trials until the next look: one task per trial, or one for all if the
    /// controller's history is part of the experiment.
    fn tasks(&self, scenario: usize) -> Vec<TrialTask> {
        let mut played = self.lock_trials();
        if played.is_judged {
            return Vec::new();
        }
        played.deadline = None;
        let trials = played.records.len() as u32..played.trials_until_look;
        if self.scenario.keeps_controller() && !trials.is_empty() {
            return vec![TrialTask { scenario, trials }];
        }
        trials.map(|index| TrialTask { scenario, trials: index..index + 1 }).collect()
    }
}

fn write_trace(folder: &RunFolder, trace: &str, rows: &[Row]) -> Result<[u8; 32], TraceError> {
    let mut writer = TraceWriter::create_in(folder.output(), trace)?;
    rows.iter().try_for_each(|row| writer.write(row))?;
    writer.finish()
}

fn write_frames(folder: &RunFolder, path: &str, frames: &[u8]) -> Result<(), FolderError> {
    let mut file = folder.output().create_file(path)?;
    file.write_all(frames).at(&folder.path().join(path))?;
    Ok(file.commit_without_sync()?)
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
        folder.output().remove_file(&trial.trace).map_err(FolderError::from)?;
        trial.sha256 = None;
    }
    Ok(())
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("no message").to_owned()
}
