//! Names why a trial has no value of a metric.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Why a trial has no value of a metric, if that is the controller's failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Error)]
#[serde(rename_all = "snake_case")]
pub enum MissingValue {
    /// Settling: the signal ends outside the band.
    #[error("never stays inside the band")]
    NeverSettles,
    /// Recovery: the signal ends outside the band.
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
    /// The controller is not running at the end of the trial.
    #[error("ends with the controller not running")]
    NotRunning,
    /// The bench replaced a NaN or infinite drive by 0 V, so the trace does not show what was
    /// commanded.
    #[error("the drive command was NaN or infinite; 0 V was applied")]
    NonFiniteDrive,
}

impl MissingValue {
    /// True if the event that a metric times did not happen.
    pub const fn is_not_reached(self) -> bool {
        matches!(self, Self::NeverSettles | Self::NeverRecovers | Self::NotAtRest)
    }
}

/// Why a metric does not apply to a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Error)]
#[serde(rename_all = "snake_case")]
pub enum UndefinedValue {
    /// The trace has no rows.
    #[error("the trace is empty")]
    EmptyTrace,
    /// The setpoint is constant.
    #[error("the setpoint never steps")]
    NoSetpointStep,
    /// A band is relative to the setpoint.
    #[error("a setpoint of 0 has no band")]
    NoBand,
    /// The setpoint is 0 after the disturbance.
    #[error("no setpoint to recover to")]
    NoSetpointToRecoverTo,
    /// The setpoint is 0 in the window.
    #[error("no setpoint to deviate from")]
    NoSetpointToDeviateFrom,
    /// The step ends at its start value.
    #[error("the setpoint returns to its start value")]
    NoNetStep,
    /// Wq/Wd has no value.
    #[error("Wd is 0 at the end")]
    NoInPhaseComponent,
    /// A mean needs a constant setpoint.
    #[error("the setpoint changes in the window")]
    SetpointChanges,
    /// A relative error needs a setpoint above 0.
    #[error("the setpoint is 0 in the window")]
    ZeroSetpoint,
    /// The window contains no rows.
    #[error("no rows in the window")]
    EmptyWindow,
    /// The rig does not measure it.
    #[error("the rig does not report it")]
    NotReported,
    /// Real plate: its resonance is unknown.
    #[error("the true resonance of a real plate is not known")]
    UnknownResonance,
    /// Real plate: a person disturbs it.
    #[error("the instant at which a person's hand disturbs a real plate is not known")]
    UnknownDisturbance,
    /// Real plate: the controller has its own sensor and amplifier.
    #[error("the bench is not in the loop of a real plate")]
    NotInLoop,
    /// Real plate: instructions are not counted.
    #[error("a controller that drives a real plate does not report its instructions")]
    UncountedInstructions,
}
