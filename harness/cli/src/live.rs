//! `--live`: the view in the terminal, for whichever command has one.

use crate::output;
use platebench_live::{Show, Subject, Told, View};
use platebench_runner::{Clock, Event, Plan, Watch};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The keys where the run alone decides.
pub(crate) const KEYS: &str = "q or Ctrl-C ends the run, with the plate at 0 V";

const SESSION_KEYS: &str = "Ctrl-C ends the session, with the plate at 0 V; --resume goes on with it";

/// What of a plan can be looked at.
pub(crate) fn subject(command: &'static str, keys: &'static str, plan: &Plan) -> Subject {
    Subject {
        command,
        place: plan.rig.clone(),
        lockstep: matches!(plan.clock, Clock::Lockstep { .. }),
        jobs: plan.jobs,
        keys,
        shows: plan.scenarios.iter().map(Show::of).collect(),
    }
}

/// Takes the terminal where there is one; where there is none, says so and goes on without.
pub(crate) fn open(subject: Subject) -> (Option<View>, Watch) {
    let (watch, viewer) = Watch::new();
    match View::open(subject, viewer) {
        Ok(view) => (Some(view), watch),
        Err(why) => {
            output::note(&format!("no live view: {why}"));
            (None, Watch::default())
        }
    }
}

/// The view of a session, which comes and goes with its scenarios.
#[derive(Debug, Clone)]
pub(crate) struct Shown(Option<Arc<Mutex<Option<View>>>>);

impl Shown {
    /// One that never shows anything unless `wanted`.
    pub(crate) fn new(wanted: bool) -> Self {
        Self(wanted.then(Arc::default))
    }

    fn place(&self) -> Option<MutexGuard<'_, Option<View>>> {
        self.0.as_deref().map(|place| place.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Shows what is played from now on; `None` where nothing is shown.
    pub(crate) fn open(&self, plan: &Plan) -> Option<Watch> {
        let mut place = self.place()?;
        // The terminal is taken once.
        *place = None;
        let (view, watch) = open(subject("accept", SESSION_KEYS, plan));
        *place = Some(view?);
        Some(watch)
    }

    /// Tells the view, where there is one.
    pub(crate) fn tell(&self, event: &Event) {
        if let (Some(Some(view)), Some(news)) = (self.place().as_deref(), Told::of(event)) {
            view.tell(news);
        }
    }

    /// Gives the terminal back, where it is taken.
    pub(crate) fn close(&self) {
        if let Some(mut place) = self.place() {
            *place = None;
        }
    }
}
