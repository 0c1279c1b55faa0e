//! Defines the value of a metric in one trial.

use platebench_record::{MissingValue, UndefinedValue};

#[derive(Debug, Clone, PartialEq)]
pub enum Measure {
    /// The static error keeps its sign: mean − setpoint.
    Value(f64),
    /// Contains the number, because the signal is known at samples only.
    Interval([f64; 2]),
    /// The signal at the control instants of the window, to be compared with that of the first trial.
    Samples(Vec<f64>),
    /// No number, which is the controller's failure.
    Missing(MissingValue),
    Undefined(UndefinedValue),
}

impl Measure {
    /// The upper end of an interval.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) | Self::Interval([_, value]) => Some(*value),
            Self::Samples(_) | Self::Missing(_) | Self::Undefined(_) => None,
        }
    }
}
