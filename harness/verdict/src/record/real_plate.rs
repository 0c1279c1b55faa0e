//! How a trial on a real plate went, beside its trace.

use super::Quantiles;
use serde::{Deserialize, Serialize};

/// What the bench heard of a controller that drives its own plate, and what a person did for it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RealPlate {
    /// Control periods that the controller told of.
    pub periods: u64,
    /// Control periods between them that nothing was heard of.
    pub missing: u64,
    /// Setpoints that were sent.
    pub setpoints: u64,
    /// Of these, without an acknowledgement in time.
    pub unacknowledged: u64,
    /// From sending a setpoint to its acknowledgement, µs; `null` where none came.
    pub acknowledged_us: Option<Quantiles>,
    /// Frames that could not be read.
    pub refused_frames: u64,
    /// Rows that found no room on their way out of the loop.
    pub lost_rows: u64,
    /// How much faster than the bench's clock the controller's runs, parts per million, with its standard error; `null` where too little was heard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_ppm: Option<[f64; 2]>,
    /// True where the controller measures the finger's force.
    pub force_measured: bool,
    /// True where the controller confirmed 0 V at the end of the trial.
    pub safe_confirmed: bool,
    /// What a person was asked to do, in the order of asking.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub asked: Vec<Asked>,
    /// Why the plate's surroundings are not those of the scenario, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undone: Option<String>,
}

/// Something that a person was asked to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Asked {
    /// In the words of the prompt.
    pub what: String,
    /// True where the person said that it is done.
    pub done: bool,
}
