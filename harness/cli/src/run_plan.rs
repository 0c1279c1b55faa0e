//! Plays a plan on a separate thread, forwards its events, also to the live view of `--live`, and
//! stops it after a signal.

use crate::prompt::TerminalOperator;
use crate::shutdown::{EventSender, run_until_signal};
use crate::stdio;
use platebench_engine::{CancelToken, Event, LiveTap, RunError, RunHooks, RunPlan};
use platebench_model::record::{PlannedScenario, RunFolder, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_report::events::EventWriter;
use platebench_report::live::{LiveView, RunDescription};
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

    pub(crate) fn send(&mut self, mut event: Event) {
        if let (Some(kept), Event::TrialFinished { trial, rows, .. }) = (&mut self.rows, &mut event) {
            kept.add(&trial.trace, std::mem::take(rows));
        }
        self.progress.show(&event);
        if let Some(view) = self.view {
            view.show(&event);
        }
        if let Some(events) = &mut self.events {
            events.write(&event);
        }
    }
}

/// The first event of a run.
pub(crate) fn run_started(plan: &RunPlan, folder: &RunFolder) -> Event {
    let planned =
        |scenario: &Scenario| PlannedScenario { scenario: scenario.file.clone(), trials: scenario.trials.count };
    Event::RunStarted {
        format: Event::FORMAT,
        folder: folder.path().display().to_string(),
        rig: plan.rig.clone(),
        clock: plan.clock.kind().name().to_owned(),
        scenarios: plan.scenarios.iter().map(planned).collect(),
    }
}

/// If the run ends early, returns the error and the signal that ended the run.
pub(crate) fn run_plan(
    plan: Arc<RunPlan>,
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
    let (result, signal) = run_until_signal(None, run, |event| sinks.send(event));
    sinks.progress.finish();
    result.flatten().map_err(|error| (error, signal))
}

pub(crate) const KEYS: &str = "q or Ctrl-C ends the run, with the plate at 0 V";

const SESSION_KEYS: &str = "Ctrl-C ends the session, with the plate at 0 V; --resume continues it";

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
        let (view, live_tap) = open_view(RunDescription {
            command: "acceptance run",
            key_help: SESSION_KEYS,
            plan: Arc::new(plan.clone()),
            has_end: true,
        });
        *slot = Some(view?);
        Some(live_tap)
    }

    pub(crate) fn send(&self, event: &Event) {
        if let Some(Some(view)) = self.lock_view().as_deref() {
            view.show(event);
        }
    }

    pub(crate) fn close(&self) {
        if let Some(mut slot) = self.lock_view() {
            *slot = None;
        }
    }
}
