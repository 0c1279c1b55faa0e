//! Records a trial.

use crate::metrics::RigReports;
use crate::record::metric_values::MetricValues;
use crate::record::real_plate::RealPlateRecord;
use crate::record::reason::{self, TrialReason};
use crate::record::step_time::StepTime;
use crate::record::timing::TimingRecord;
use crate::record::verdict::Cause;
use crate::record::violation::Violation;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrialRecord {
    /// Counted from 0.
    pub index: u32,
    pub seed: u64,
    /// Path of the trace, relative to the run folder.
    pub trace: String,
    /// SHA-256 of the trace, hexadecimal; `null` if the trial was cut off before it was recorded.
    #[serde(default)]
    pub sha256: Option<String>,
    /// Value by metric; `null` if the trial has no number. The second expectation of a metric has
    /// the suffix `[2]`.
    pub metrics: MetricValues,
    #[serde(default)]
    pub telemetry: Telemetry,
    pub cause: Option<Cause>,
    #[serde(flatten, with = "reason::file_keys")]
    #[schemars(with = "reason::file_keys::Keys<TrialReason>")]
    pub reason: Option<TrialReason>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diverged_at_s: Option<f64>,
    /// Wall-clock time of the trial, ms; `null` if the trial was judged again.
    pub wall_ms: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Telemetry {
    /// Longest time from sampling to actuation as it acted on the plate, µs.
    pub loop_delay_us: Option<f64>,
    /// Longest time from sample to command through line and controller, µs; includes commands that
    /// did not act.
    pub rig_delay_us: Option<f64>,
    pub instructions_mean: Option<f64>,
    pub instructions_worst: Option<f64>,
    /// Absent on rigs that do not count instructions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step_time: Option<StepTime>,
    /// Largest difference of a command from the reference implementation; absent without a
    /// comparison.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_difference_percent: Option<f64>,
    /// A sentence for each message script with an answer that differs from the reference; absent if
    /// none was sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub protocol_differences: Option<Vec<String>>,
    /// Number of message scripts that were repeated because the line may have lost an answer or the
    /// host stalled.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub protocol_repeats: u32,
    /// The rig's message about the loss of the controller.
    #[serde(default)]
    pub ended: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<Box<TimingRecord>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_plate: Option<Box<RealPlateRecord>>,
    /// The controller's first reason for a stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Text that the firmware wrote by RTT.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub firmware_output: Option<String>,
    /// Number of messages that planned faults changed, by kind of fault.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub not_finite: Option<NonFiniteDrive>,
    /// Watchdog timeout of a controller whose clock runs while the plate waits, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub watchdog_timeout_ms: Option<u16>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub violations: Vec<Violation>,
}

impl Telemetry {
    pub fn reports(&self) -> RigReports {
        RigReports {
            loop_delay_us: self.loop_delay_us,
            instructions_worst: self.instructions_worst,
            step_time_percent: self.step_time.map(|step| step.longest_percent),
            reference_difference_percent: self.reference_difference_percent,
            protocol_differences: self.protocol_differences.as_ref().map(|all| all.len() as f64),
        }
    }

    /// Adds what a scene between the trials shows about the controller. Its motion of the plate is
    /// not judged.
    pub fn include_scene(&mut self, scene: Self) {
        self.violations.extend(scene.violations);
        if let Some(steps) = scene.step_time {
            self.step_time.get_or_insert_default().include(&steps);
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde fixes the signature")]
const fn is_zero(count: &u32) -> bool {
    *count == 0
}

/// Commands that were NaN or infinite. The bench applied 0 V, so the trace does not contain them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NonFiniteDrive {
    pub at_s: f64,
    pub count: u64,
}
