//! Defines the value of a metric in one trial, the instants that decided it, and why a value is
//! missing.

use crate::trace::Row;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

#[derive(Debug, Clone, PartialEq)]
pub enum Measure {
    /// The static error keeps its sign: mean − setpoint.
    Value(f64),
    /// Interval that contains the value, because the signal is known at control instants only.
    Interval([f64; 2]),
    /// The signal at the control instants of the window, for the comparison with the first trial.
    Samples(Vec<f64>),
    Missing(MissingValue),
    Undefined(UndefinedValue),
}

impl Measure {
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) | Self::Interval([_, value]) => Some(*value),
            Self::Samples(_) | Self::Missing(_) | Self::Undefined(_) => None,
        }
    }
}

/// A measure, and the instants of the signal that decided it.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    pub measure: Measure,
    /// Empty if no instant of a signal decides, as for a count.
    pub worst: Vec<SignalPoint>,
}

impl Measurement {
    pub(crate) fn value_at(value: f64, worst: impl IntoIterator<Item = SignalPoint>) -> Self {
        Self { measure: Measure::Value(value), worst: worst.into_iter().collect() }
    }
}

impl From<Measure> for Measurement {
    fn from(measure: Measure) -> Self {
        Self { measure, worst: Vec::new() }
    }
}

impl From<f64> for Measurement {
    fn from(value: f64) -> Self {
        Measure::Value(value).into()
    }
}

/// Value of a signal at an instant, in the unit of the signal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SignalPoint {
    pub t_ms: f64,
    pub value: f64,
}

impl SignalPoint {
    /// The instant is rounded to 1 ns.
    pub(crate) fn new(t_s: f64, value: f64) -> Self {
        Self { t_ms: (t_s * 1e9).round() / 1e6, value }
    }

    pub(crate) fn of(row: &Row, value: impl Fn(&Row) -> f64) -> Self {
        Self::new(row.t_s, value(row))
    }
}

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
    #[error("the pin PB0 was never high")]
    NeverEnabled,
    #[error("the pin PB0 is high at the end")]
    StaysEnabled,
    #[error("the firmware did not write the text")]
    NoText,
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
        matches!(self, Self::NeverSettles | Self::NeverRecovers | Self::NotAtRest | Self::StaysEnabled | Self::NoText)
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
    #[error("the bench keeps the first 16 KiB of the firmware's text, and the text is not in them")]
    CutText,
    #[error("the true resonance of a real plate is not known")]
    UnknownResonance,
    #[error("the instant at which a person's hand disturbs a real plate is not known")]
    UnknownDisturbance,
    #[error("the bench is not in the control loop of a real plate and cannot measure this")]
    NotInLoop,
    #[error("a controller that drives a real plate does not report its instructions")]
    UncountedInstructions,
    #[error(
        "scripts with other answers contain an exchange of more than 80 ms each time, so the computer may have stalled"
    )]
    StalledScripts,
}
