//! Opens the live view of the option `--live`.

use crate::stdio;
use platebench_engine::{Clock, Event, LiveTap, RunPlan};
use platebench_report::live::{LiveView, RunDescription, ScenarioDescription, ViewEvent};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

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
