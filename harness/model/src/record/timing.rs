//! Records lateness and loop delay of a real-time trial.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Times are wall-clock times unless stated otherwise.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TimingRecord {
    /// Clock that sets the control instants: `bench` or `target`.
    pub pacing: String,
    /// Seconds of plate time per second of wall-clock time.
    pub time_scale: f64,
    /// Scheduling of the loop's thread, or why it is not real-time.
    pub scheduling: String,
    pub memory_locked: bool,
    pub periods: u64,
    pub overruns: u64,
    pub skipped: u64,
    /// Samples without an answer in time. If `pacing` is `target`, also periods without a tick of
    /// the target.
    pub missed_replies: u64,
    /// Samples that are still without an answer at the end of the trial.
    #[serde(default)]
    pub lost_replies: u64,
    pub rejected_frames: u64,
    pub lost_rows: u64,
    /// Time from a control instant to its sample, µs.
    pub lateness_us: Quantiles,
    /// From control instant to actuation, µs of plate time; `null` without an answer.
    pub loop_delay_us: Option<Quantiles>,
    /// Longest constant delay at which the law settles on the nominal plate, µs of plate time.
    pub loop_delay_budget_us: Option<f64>,
    /// Deviation of the target's clock from the bench's, positive if fast; `null` if unknown.
    pub target_clock_ppm: Option<f64>,
    pub target_clock_error_ppm: Option<f64>,
    pub safe_confirmed: bool,
    /// Time that the hypervisor took from this machine's processors during the trial, ms; `null` if
    /// unknown.
    #[serde(default)]
    pub steal_ms: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Quantiles {
    pub p50: f64,
    pub p99: f64,
    pub p999: f64,
    pub max: f64,
}
