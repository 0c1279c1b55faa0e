//! Describes a session: plan, rig, record folder, and who observes it.

use crate::plan::Plan;
use crate::session_record::StepRecord;
use crate::signature::SecretKey;
use platebench_rig::RigSpec;
use platebench_runner::{CancelToken, Clock, Event, LiveTap, Operator, RunPlan};
use std::path::PathBuf;

#[derive(Debug, Clone)]
pub struct SessionConfig {
    pub plan: Plan,
    pub rig: RigSpec,
    pub clock: Clock,
    pub jobs: usize,
    pub out: PathBuf,
    /// If true, the folder must hold a session to resume.
    pub resume: bool,
    pub details: SessionDetails,
    pub signing_key: Option<SecretKey>,
    /// Instruments whose invalid calibration does not stop the session.
    pub waived_calibrations: Vec<String>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SessionDetails {
    pub operator: Option<String>,
    pub place: Option<String>,
    pub notes: Option<String>,
}

pub struct SessionHooks<'a> {
    pub operator: &'a dyn Operator,
    pub observer: &'a mut dyn SessionObserver,
    pub cancel: &'a CancelToken,
}

pub trait SessionObserver {
    fn step_started(&mut self, _step: &StepRecord) {}
    fn step_ended(&mut self, _step: &StepRecord) {}
    fn run_event(&mut self, _event: &Event) {}
    /// Called before a run starts; by default there is no live view.
    fn live_tap(&mut self, _plan: &RunPlan) -> LiveTap {
        LiveTap::default()
    }
}
