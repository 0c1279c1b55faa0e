//! Names why a trial does not count.

use crate::record::verdict::Cause;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Instants are in ms after the start of the trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum Exclusion {
    #[error("no answer at {at_ms} ms")]
    NoAnswer { at_ms: f64 },
    #[error("the bench was too late {count}×, first at {first_ms} ms")]
    LateBench { count: usize, first_ms: f64 },
    /// The controller's timer is off by more than an oscillator can be.
    #[error("the controller's clock differs by {:+.0} % from the bench's: \
        its periods are not the scenario's", ppm / 1e4)]
    WrongClock {
        /// Positive if the controller's clock is fast, parts per million.
        ppm: f64,
    },
    #[error("{count} rows were lost between control loop and trace")]
    LostRows { count: u64 },
    #[error("the trace starts at {at_ms} ms")]
    LateStart { at_ms: f64 },
    #[error("no rows between {from_ms} and {to_ms} ms, expected one every {step_ms} ms")]
    Gap { from_ms: f64, to_ms: f64, step_ms: f64 },
    #[error("the trace ends at {at_ms} ms instead of {duration_ms} ms")]
    EarlyEnd { at_ms: f64, duration_ms: f64 },
    #[error("the run was cut off before this trial was complete")]
    CutOff,
    #[error("its trace is missing")]
    MissingTrace,
    #[error("the bench was too late with a setpoint at {at_ms} ms")]
    LateSetpoint { at_ms: f64 },
    #[error("a setpoint was not acknowledged by {at_ms} ms")]
    Unacknowledged { at_ms: f64 },
    #[error("the telemetry starts at {at_ms} ms")]
    LateTelemetry { at_ms: f64 },
    #[error("no telemetry between {from_ms} and {to_ms} ms")]
    TelemetryGap { from_ms: f64, to_ms: f64 },
    #[error("the telemetry ends at {at_ms} ms instead of {duration_ms} ms")]
    EarlyTelemetryEnd { at_ms: f64, duration_ms: f64 },
    #[error("the controller held a setpoint of {held_um} µm at {at_ms} ms, expected {}", range(*sent_um))]
    WrongSetpoint {
        held_um: f64,
        at_ms: f64,
        /// Smallest and largest setpoint of the scenario around this instant, µm.
        sent_um: [f64; 2],
    },
    #[error("{why}")]
    ConditionsNotMade { why: String },
    #[error("finger or temperature change within a trial of {duration_ms} ms, which is too short for an operator")]
    TooFastForOperator { duration_ms: f64 },
    #[error("finger and temperature of this trial were neither measured nor confirmed by an operator")]
    UnknownConditions,
    #[error(
        "the finger pressed with {force_n:.2} N at {at_ms} ms, expected {}; {wrong_rows} of {rows} rows have another \
         force",
        range(*expected_n)
    )]
    WrongForce {
        force_n: f64,
        at_ms: f64,
        /// Smallest and largest force of the scenario around this instant, N.
        expected_n: [f64; 2],
        wrong_rows: usize,
        rows: usize,
    },
}

fn range([low, high]: [f64; 2]) -> String {
    if low == high { format!("{low}") } else { format!("{low} to {high}") }
}

impl Exclusion {
    pub const fn cause(&self) -> Cause {
        match self {
            Self::LateBench { .. }
            | Self::LostRows { .. }
            | Self::LateStart { .. }
            | Self::Gap { .. }
            | Self::EarlyEnd { .. }
            | Self::CutOff
            | Self::LateSetpoint { .. } => Cause::Bench,
            Self::MissingTrace => Cause::Evidence,
            Self::NoAnswer { .. }
            | Self::WrongClock { .. }
            | Self::Unacknowledged { .. }
            | Self::LateTelemetry { .. }
            | Self::TelemetryGap { .. }
            | Self::EarlyTelemetryEnd { .. }
            | Self::WrongSetpoint { .. }
            | Self::ConditionsNotMade { .. }
            | Self::TooFastForOperator { .. }
            | Self::UnknownConditions
            | Self::WrongForce { .. } => Cause::Rig,
        }
    }
}
