//! Describes a session: plan, rig, record folder, and who observes it.

use crate::plan::Plan;
use crate::session_record::StepRecord;
use crate::signature::SecretKey;
use platebench_rig::RigSpec;
use platebench_runner::{CancelToken, Clock, Event, LiveTap, Operator, RunPlan};
use std::path::PathBuf;

/// A session to conduct.
#[derive(Debug, Clone)]
pub struct SessionConfig {
    /// The plan.
    pub plan: Plan,
    /// What the controller runs on.
    pub rig: RigSpec,
    /// How time passes for the plate.
    pub clock: Clock,
    /// How many trials may run at once.
    pub jobs: usize,
    /// The record's folder.
    pub out: PathBuf,
    /// True if the folder must hold a session to resume.
    pub resume: bool,
    /// Details from the command line.
    pub details: SessionDetails,
    /// The key that signs the record.
    pub signing_key: Option<SecretKey>,
}

/// Details of a session for its record.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SessionDetails {
    /// The operator's name.
    pub operator: Option<String>,
    /// The place.
    pub place: Option<String>,
    /// Notes.
    pub notes: Option<String>,
}

/// Who accompanies a session.
pub struct SessionHooks<'a> {
    /// The person who is asked.
    pub operator: &'a dyn Operator,
    /// Receives the session's progress.
    pub observer: &'a mut dyn SessionObserver,
    /// Ends the session early.
    pub cancel: &'a CancelToken,
}

/// Receives the progress of a session.
pub trait SessionObserver {
    /// A step begins.
    fn step_started(&mut self, _step: &StepRecord) {}
    /// A step has ended.
    fn step_ended(&mut self, _step: &StepRecord) {}
    /// An event of a step's run.
    fn run_event(&mut self, _event: &Event) {}
    /// The live view of a run that is about to start; the default has none.
    fn live_tap(&mut self, _plan: &RunPlan) -> LiveTap {
        LiveTap::default()
    }
}
