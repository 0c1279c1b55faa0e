//! Records a trial on a real plate.

use crate::timing::Quantiles;
use serde::{Deserialize, Serialize};

/// Messages of a controller that drives its own plate, and actions of the operator.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RealPlateRecord {
    /// Control periods that the controller reported.
    pub periods: u64,
    /// Control periods between them without a report.
    pub missing: u64,
    /// Setpoints that were sent.
    pub setpoints: u64,
    /// Setpoints without an acknowledgement in time.
    pub unacknowledged: u64,
    /// From sending a setpoint to its acknowledgement, µs; `None` if there was none.
    pub acknowledged_us: Option<Quantiles>,
    /// Frames that were rejected.
    pub rejected_frames: u64,
    /// Rows that were lost between control loop and trace.
    pub lost_rows: u64,
    /// Deviation of the controller's clock from the bench's, positive if fast, and its standard
    /// error, parts per million.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_ppm: Option<[f64; 2]>,
    /// True if the controller measures the finger's force.
    pub force_measured: bool,
    /// True if the controller confirmed 0 V at the end of the trial.
    pub safe_confirmed: bool,
    /// Requests to the operator, in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub asked: Vec<OperatorRequest>,
    /// Why the operator did not make the conditions of the scenario.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undone: Option<String>,
}

/// A request to the operator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OperatorRequest {
    /// Text of the prompt.
    pub what: String,
    /// True if the operator confirmed it.
    pub done: bool,
}
