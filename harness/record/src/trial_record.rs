//! Records a trial.

use crate::real_plate::RealPlateRecord;
use crate::reason::{self, TrialReason};
use crate::timing::TimingRecord;
use crate::verdict::Cause;
use crate::violation::Violation;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// One trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRecord {
    /// Counted from 0.
    pub index: u32,
    /// Seed of its plate, sensor and noise.
    pub seed: u64,
    /// Its trace, relative to the run folder.
    pub trace: String,
    /// SHA-256 of the trace, hexadecimal; `None` if the trial was cut off before it was recorded.
    #[serde(default)]
    pub sha256: Option<String>,
    /// Values by metric; the n-th further expectation of a metric has the suffix `[n]`. `null` if
    /// there is no number.
    pub metrics: Map<String, Value>,
    /// What the rig reported.
    #[serde(default)]
    pub telemetry: Telemetry,
    /// What made the trial not count.
    pub cause: Option<Cause>,
    /// Why it does not count or did not end well.
    #[serde(flatten, with = "reason::file_keys")]
    pub reason: Option<TrialReason>,
    /// When the loop diverged, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diverged_at_s: Option<f64>,
    /// Wall-clock time of the trial, ms; `None` if the trial was judged again.
    pub wall_ms: Option<f64>,
}

/// What the rig reported about a trial.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Telemetry {
    /// Longest time from sampling to actuation as it acted on the plate, µs.
    pub loop_delay_us: Option<f64>,
    /// Longest time of line and controller on the target's clock, even if it did not act on the
    /// plate, µs.
    pub rig_delay_us: Option<f64>,
    /// Instructions per control step, mean.
    pub instructions_mean: Option<f64>,
    /// Instructions per control step, worst.
    pub instructions_worst: Option<f64>,
    /// How the controller was lost.
    #[serde(default)]
    pub ended: Option<String>,
    /// Lateness and loop delay in real time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<TimingRecord>,
    /// Trial on a plate that the controller drives itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_plate: Option<RealPlateRecord>,
    /// The controller's first report why it stopped.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Messages changed by planned faults, by kind of fault.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
    /// Drive commands that were NaN or infinite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub not_finite: Option<NonFiniteDrive>,
    /// Watchdog time-out of a controller whose clock runs while the plate waits, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub watchdog_timeout_ms: Option<u16>,
    /// Breaches of the protocol; any of them fails the trial.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub violations: Vec<Violation>,
}

/// Drive commands that were NaN or infinite. The bench applied 0 V instead, so the trace does not
/// contain them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NonFiniteDrive {
    /// When the first one acted, s.
    pub at_s: f64,
    /// Their number.
    pub count: u64,
}
