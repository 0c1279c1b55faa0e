//! Records a trial.

use crate::metric_values::MetricValues;
use crate::real_plate::RealPlateRecord;
use crate::reason::{self, TrialReason};
use crate::timing::TimingRecord;
use crate::verdict::Cause;
use crate::violation::Violation;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrialRecord {
    /// Counted from 0.
    pub index: u32,
    pub seed: u64,
    /// Its trace, relative to the run folder.
    pub trace: String,
    /// SHA-256 of the trace, hexadecimal; `None` if the trial was cut off before it was recorded.
    #[serde(default)]
    pub sha256: Option<String>,
    /// By metric; `null` without a number. Further expectations of a metric have the suffix `[n]`.
    pub metrics: MetricValues,
    #[serde(default)]
    pub telemetry: Telemetry,
    /// What made the trial not count.
    pub cause: Option<Cause>,
    #[serde(flatten, with = "reason::file_keys")]
    #[schemars(with = "reason::file_keys::Keys<TrialReason>")]
    pub reason: Option<TrialReason>,
    /// When the loop diverged, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diverged_at_s: Option<f64>,
    /// Wall-clock time of the trial, ms; `None` if the trial was judged again.
    pub wall_ms: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Telemetry {
    /// Longest time from sampling to actuation as it acted on the plate, µs.
    pub loop_delay_us: Option<f64>,
    /// Longest time of line and controller on the target's clock, also if it did not act, µs.
    pub rig_delay_us: Option<f64>,
    pub instructions_mean: Option<f64>,
    pub instructions_worst: Option<f64>,
    /// Largest difference of a command from the reference; `None` without a comparison.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_difference_percent: Option<f64>,
    /// Scripts of messages with another answer than that of the reference; `None` if none was played.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub protocol_differences: Option<Vec<String>>,
    /// How the controller was lost, in the rig's words.
    #[serde(default)]
    pub ended: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<Box<TimingRecord>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_plate: Option<Box<RealPlateRecord>>,
    /// The controller's first report why it stopped.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Text that the firmware wrote by RTT.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub firmware_output: Option<String>,
    /// Messages changed by planned faults, by kind of fault.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub not_finite: Option<NonFiniteDrive>,
    /// Watchdog time-out of a controller whose clock runs while the plate waits, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub watchdog_timeout_ms: Option<u16>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub violations: Vec<Violation>,
}

/// Commands that were NaN or infinite; the bench applied 0 V, so the trace does not contain them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NonFiniteDrive {
    pub at_s: f64,
    pub count: u64,
}
