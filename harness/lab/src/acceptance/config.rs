//! Describes a session: plan, rig, record folder, operator and observer.

use crate::acceptance::plan::Plan;
use crate::acceptance::session_record::{SessionDetails, StepRecord};
use crate::acceptance::signature::SecretKey;
use platebench_engine::{CancelToken, Clock, Event, LiveTap, Operator, RunPlan};
use platebench_rig::RigSpec;
use std::path::PathBuf;

#[derive(Debug, Clone)]
pub struct SessionConfig {
    pub plan: Plan,
    pub rig: RigSpec,
    pub clock: Clock,
    pub jobs: usize,
    pub out: PathBuf,
    /// If true, `out` must contain a session to resume.
    pub resume: bool,
    pub details: SessionDetails,
    pub signing_key: Option<SecretKey>,
    /// Names of instruments whose invalid calibration does not stop the session.
    pub waived_calibrations: Vec<String>,
}

pub struct SessionHooks<'a> {
    pub operator: &'a dyn Operator,
    pub observer: &'a mut dyn SessionObserver,
    pub cancel: &'a CancelToken,
}

pub trait SessionObserver {
    fn step_started(&mut self, step: &StepRecord);
    fn step_ended(&mut self, step: &StepRecord);
    fn run_event(&mut self, event: &Event);
    fn live_tap(&mut self, plan: &RunPlan) -> LiveTap;
}
