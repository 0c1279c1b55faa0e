//! Records a trial on a real plate.

use crate::record::timing::Quantiles;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RealPlateRecord {
    /// Control periods that the controller reported.
    pub periods: u64,
    /// Control periods without a report between them.
    pub missing: u64,
    pub setpoints: u64,
    pub unacknowledged: u64,
    /// From sending a setpoint to its acknowledgement, µs; `None` if there was none.
    pub acknowledged_us: Option<Quantiles>,
    pub rejected_frames: u64,
    pub lost_rows: u64,
    /// Deviation of the controller's clock from the bench's, positive if fast, and its standard
    /// error; ppm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_ppm: Option<[f64; 2]>,
    pub force_measured: bool,
    pub safe_confirmed: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub asked: Vec<OperatorRequest>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undone: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct OperatorRequest {
    pub what: String,
    pub done: bool,
}
