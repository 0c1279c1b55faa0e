//! Holds the value of a metric in one trial.

use platebench_record::{MissingValue, UndefinedValue};

/// The value of a metric in one trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Measure {
    /// A number. The static error keeps its sign: mean − setpoint.
    Value(f64),
    /// An interval that contains the number, because the signal is known at samples only.
    Interval([f64; 2]),
    /// No number, and that is the controller's failure.
    Missing(MissingValue),
    /// No number, because the metric does not apply to the trial.
    Undefined(UndefinedValue),
}

impl Measure {
    /// The number, if there is one; the upper end of an interval.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) | Self::Interval([_, value]) => Some(*value),
            Self::Missing(_) | Self::Undefined(_) => None,
        }
    }
}
