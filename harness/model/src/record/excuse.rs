//! Names why a missed expectation is not the controller's failure.

use crate::metrics::{Metric, MissingValue};
use crate::record::verdict::Cause;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;
use thiserror::Error;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum Excuse {
    #[error(
        "saturated: holding the setpoint needs {needed_vpp:.0} Vpp, \
         the amplifier gives {limit_vpp:.0} Vpp: at best {best}"
    )]
    SetpointOutOfReach {
        /// Drive that holds the setpoint at resonance.
        needed_vpp: f64,
        limit_vpp: f64,
        best: BestResponse,
    },
    #[error("saturated: from 0 to {limit_vpp:.0} Vpp no controller does better than {best}")]
    DriveLimited { limit_vpp: f64, best: BestResponse },
    #[error(
        "the drive was at its limit at {at_ms} ms; for a real plate the bench cannot compute whether another \
         controller would do better"
    )]
    SaturatedRealPlate { at_ms: f64 },
    #[error(
        "trial {trial}: at this rig's loop delay of {typical_us:.0} µs (longest {longest_us:.0} µs) the law itself \
         gets {}, without it {}; a slower --time-scale makes the delay smaller",
        value(*delayed),
        value(*undelayed)
    )]
    LoopDelay { trial: u32, typical_us: f64, longest_us: f64, delayed: Option<f64>, undelayed: Option<f64> },
    #[error("in real time the loop delay includes line and bench, not the controller alone")]
    RealTimeDelay,
}

impl Excuse {
    pub const fn cause(&self) -> Cause {
        match self {
            Self::SetpointOutOfReach { .. } | Self::DriveLimited { .. } => Cause::Infeasible,
            Self::SaturatedRealPlate { .. } => Cause::Evidence,
            Self::LoopDelay { .. } | Self::RealTimeDelay => Cause::Rig,
        }
    }
}

fn value(value: Option<f64>) -> String {
    value.map_or_else(|| "no value".to_owned(), |value| format!("{value:.3}"))
}

/// What the best possible controller reaches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BestResponse {
    Value(Metric, f64),
    /// Mean over the window, percent of the setpoint.
    Mean(f64),
    Missing(MissingValue),
}

impl fmt::Display for BestResponse {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Value(metric, value) => write!(formatter, "{metric} {value:.3}"),
            Self::Mean(percent) => write!(formatter, "a mean of {percent:.3} % of the setpoint"),
            Self::Missing(missing) => write!(formatter, "a signal that {missing}"),
        }
    }
}
