//! Names why a trial has no value of a metric.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Why a trial has no value of a metric, if the controller is responsible.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum MissingValue {
    #[error("never stays inside the band")]
    NeverSettles,
    #[error("never stays inside the band again")]
    NeverRecovers,
    #[error("the controller never ran")]
    NeverRan,
    #[error("the drive was always 0 V")]
    NeverDrove,
    #[error("the controller does not stop at 0 V")]
    NotAtRest,
    #[error("the controller stopped before the window began")]
    StoppedBefore,
    #[error("the controller does not run at the end")]
    NotRunning,
    #[error("the drive command was NaN or infinite; 0 V was applied")]
    NonFiniteDrive,
}

impl MissingValue {
    /// True if the metric is the time of an event that did not happen.
    pub const fn is_not_reached(self) -> bool {
        matches!(self, Self::NeverSettles | Self::NeverRecovers | Self::NotAtRest)
    }
}

/// Why a metric does not apply to a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum UndefinedValue {
    #[error("the trace is empty")]
    EmptyTrace,
    #[error("the setpoint never steps")]
    NoSetpointStep,
    #[error("a setpoint of 0 has no band")]
    NoBand,
    #[error("no setpoint to recover to")]
    NoSetpointToRecoverTo,
    #[error("no setpoint to deviate from")]
    NoSetpointToDeviateFrom,
    #[error("the setpoint returns to its start value, so the step has no height")]
    NoNetStep,
    #[error("Wd is 0 at the end")]
    NoInPhaseComponent,
    #[error("the setpoint changes in the window")]
    SetpointChanges,
    #[error("the setpoint is 0 in the window")]
    ZeroSetpoint,
    #[error("no rows in the window")]
    EmptyWindow,
    #[error("the rig does not report this metric")]
    NotReported,
    #[error("the true resonance of a real plate is not known")]
    UnknownResonance,
    #[error("the instant at which a person's hand disturbs a real plate is not known")]
    UnknownDisturbance,
    #[error("the bench is not in the control loop of a real plate and cannot measure this")]
    NotInLoop,
    #[error("a controller that drives a real plate does not report its instructions")]
    UncountedInstructions,
}
