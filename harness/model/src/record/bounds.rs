//! Stores an interval that may be open on either side.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// An infinite end is `null`, because JSON has no infinity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Bounds {
    pub low: Option<f64>,
    pub high: Option<f64>,
}

impl From<[f64; 2]> for Bounds {
    fn from([low, high]: [f64; 2]) -> Self {
        let finite = |end: f64| end.is_finite().then_some(end);
        Self { low: finite(low), high: finite(high) }
    }
}

impl fmt::Display for Bounds {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.low, self.high) {
            (Some(low), Some(high)) => write!(formatter, "between {low:.4} and {high:.4}"),
            (Some(low), None) => write!(formatter, "above {low:.4}, without an upper bound"),
            (None, Some(high)) => write!(formatter, "below {high:.4}, without a lower bound"),
            (None, None) => formatter.write_str("without bounds"),
        }
    }
}
