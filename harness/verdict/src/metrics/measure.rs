//! Defines the value of a metric in one trial.

use platebench_model::record::{MissingValue, UndefinedValue};

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
