//! Plays a plan on a separate thread, forwards its events, and stops it after a signal.

use crate::prompt::TerminalOperator;
use crate::shutdown::{EventSender, WorkResult, run_until_signal};
use platebench_engine::{CancelToken, Event, LiveTap, RunError, RunHooks, RunPlan};
use platebench_model::record::{RunFolder, RunRecord};
use platebench_report::events::EventWriter;
use platebench_report::live::{LiveView, ViewEvent};
use platebench_report::page::{MAX_TRIALS, RowCache};
use platebench_report::{Progress, ProgressKind};
use platebench_rig::{ConnectOptions, RigSpec};

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
