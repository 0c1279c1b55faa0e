//! Names why a trial has no value of a metric.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Why a trial has no value of a metric, if that is the controller's failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum MissingValue {
    #[error("never stays inside the band")]
    NeverSettles,
    #[error("never stays inside the band again")]
    NeverRecovers,
    /// Shutdown: the controller was at rest during the whole window.
    #[error("never ran")]
    NeverRan,
    /// Shutdown: the drive was 0 V before the controller had to stop.
    #[error("never drove")]
    NeverDrove,
    /// Shutdown: the drive is above 0 V, or the controller runs, at the end of the window.
    #[error("does not come to rest at 0 V")]
    NotAtRest,
    /// Shutdown: the controller stopped before the window began.
    #[error("stopped before")]
    StoppedBefore,
    #[error("ends with the controller not running")]
    NotRunning,
    #[error("the drive command was NaN or infinite; 0 V was applied")]
    NonFiniteDrive,
}

impl MissingValue {
    /// True if the event that the metric times did not happen.
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
    /// A band is relative to the setpoint.
    #[error("a setpoint of 0 has no band")]
    NoBand,
    #[error("no setpoint to recover to")]
    NoSetpointToRecoverTo,
    #[error("no setpoint to deviate from")]
    NoSetpointToDeviateFrom,
    #[error("the setpoint returns to its start value")]
    NoNetStep,
    #[error("Wd is 0 at the end")]
    NoInPhaseComponent,
    #[error("the setpoint changes in the window")]
    SetpointChanges,
    #[error("the setpoint is 0 in the window")]
    ZeroSetpoint,
    #[error("no rows in the window")]
    EmptyWindow,
    #[error("the rig does not report it")]
    NotReported,
    #[error("the true resonance of a real plate is not known")]
    UnknownResonance,
    #[error("the instant at which a person's hand disturbs a real plate is not known")]
    UnknownDisturbance,
    #[error("the bench is not in the loop of a real plate")]
    NotInLoop,
    #[error("a controller that drives a real plate does not report its instructions")]
    UncountedInstructions,
}
