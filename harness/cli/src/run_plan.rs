//! Plays a plan on a separate thread, forwards its events, also to the live view of `--live`, and
//! stops it after a signal.

use crate::prompt::TerminalOperator;
use crate::shutdown::{EventSender, WorkResult, run_until_signal};
use crate::stdio;
use platebench_engine::{CancelToken, Clock, Event, LiveTap, RunError, RunHooks, RunPlan};
use platebench_model::record::{RunFolder, RunRecord};
use platebench_report::events::EventWriter;
use platebench_report::live::{LiveView, RunDescription, ScenarioDescription, ViewEvent};
use platebench_report::page::{MAX_TRIALS, RowCache};
use platebench_report::{Progress, ProgressKind};
use platebench_rig::{ConnectOptions, RigSpec};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub(crate) struct EventSinks<'a> {
    pub(crate) progress: Progress,
    pub(crate) view: Option<&'a LiveView>,
    pub(crate) events: Option<&'a mut EventWriter>,
    /// Trace rows that the report draws, so that it need not read the traces again.
    pub(crate) rows: Option<&'a mut RowCache>,
}

impl EventSinks<'_> {
    pub(crate) fn none() -> Self {
        Self { progress: Progress::new(ProgressKind::Quiet), view: None, events: None, rows: None }
    }

    fn send(&mut self, mut event: Event) {
        if let (Some(kept), Event::TrialFinished { trial, rows, .. }) = (&mut self.rows, &mut event) {
            kept.add(&trial.trace, std::mem::take(rows));
        }
        let event = &event;
        self.progress.show(event);
        if let (Some(view), Some(event)) = (self.view, ViewEvent::of(event)) {
            view.send(event);
        }
        if let Some(events) = &mut self.events {
            events.event(event);
        }
    }
}

/// If the run ends early, returns the error and the signal that ended the run.
pub(crate) fn run_plan(
    plan: RunPlan,
    folder: &RunFolder,
    rig: RigSpec,
    operator: TerminalOperator,
    live_tap: LiveTap,
    mut sinks: EventSinks<'_>,
    connect_options: ConnectOptions,
) -> Result<RunRecord, (RunError, Option<u8>)> {
    let trials_with_rows = if sinks.rows.is_some() { MAX_TRIALS } else { 0 };
    let folder = folder.clone();
    let run = move |cancel: &CancelToken, events: &mut EventSender<Event>| {
        let connect_options = ConnectOptions { cancel: cancel.clone(), ..connect_options };
        let hooks = RunHooks {
            cancel: cancel.clone(),
            operator: &operator,
            live_tap,
            on_event: Box::new(|event| events.send(event)),
            trials_with_rows,
            ..RunHooks::default()
        };
        platebench_engine::run(&plan, &folder, &|| plan.clock.connect(&rig, &connect_options), hooks)
    };
    let result = run_until_signal(None, run, |event| sinks.send(event));
    sinks.progress.finish();
    match result {
        Ok(WorkResult::Finished(result, signal)) => result.map_err(|error| (error, signal)),
        Ok(WorkResult::Abandoned(signal)) => Err((RunError::Cancelled, Some(signal))),
        Err(error) => Err((RunError::Internal(error.to_string()), None)),
    }
}

pub(crate) const KEYS: &str = "q or Ctrl-C ends the run, with the plate at 0 V";

const SESSION_KEYS: &str = "Ctrl-C ends the session, with the plate at 0 V; --resume continues it";

pub(crate) fn describe_run(command: &'static str, keys: &'static str, plan: &RunPlan) -> RunDescription {
    RunDescription {
        command,
        rig: plan.rig.clone(),
        lockstep: matches!(plan.clock, Clock::Lockstep { .. }),
        jobs: plan.jobs,
        key_help: keys,
        scenarios: plan.scenarios.iter().map(ScenarioDescription::of).collect(),
    }
}

/// If the live view cannot be opened, prints a note and returns no view.
pub(crate) fn open_view(description: RunDescription) -> (Option<LiveView>, LiveTap) {
    let (live_tap, tap_reader) = LiveTap::new();
    match LiveView::open(description, tap_reader) {
        Ok(view) => (Some(view), live_tap),
        Err(why) => {
            stdio::note(&format!("no live view: {why}"));
            (None, LiveTap::default())
        }
    }
}

/// Live view of an acceptance session. It is open only while a scenario is played.
#[derive(Debug, Clone)]
pub(crate) struct SessionView(Option<Arc<Mutex<Option<LiveView>>>>);

impl SessionView {
    pub(crate) fn new(wanted: bool) -> Self {
        Self(wanted.then(Arc::default))
    }

    pub(crate) const fn is_wanted(&self) -> bool {
        self.0.is_some()
    }

    fn lock_view(&self) -> Option<MutexGuard<'_, Option<LiveView>>> {
        self.0.as_deref().map(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(crate) fn open(&self, plan: &RunPlan) -> Option<LiveTap> {
        let mut slot = self.lock_view()?;
        // Closes the previous view first, because only one view may use the terminal.
        *slot = None;
        let (view, live_tap) = open_view(describe_run("acceptance run", SESSION_KEYS, plan));
        *slot = Some(view?);
        Some(live_tap)
    }

    pub(crate) fn send(&self, event: &Event) {
        if let (Some(Some(view)), Some(news)) = (self.lock_view().as_deref(), ViewEvent::of(event)) {
            view.send(news);
        }
    }

    pub(crate) fn close(&self) {
        if let Some(mut slot) = self.lock_view() {
            *slot = None;
        }
    }
}
