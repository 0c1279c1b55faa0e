//! Records lateness and loop delay of a real-time trial.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// In wall-clock time unless stated otherwise.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TimingRecord {
    /// Which timer makes the control instants: `bench` or `target`.
    pub pacing: String,
    /// Plate seconds per wall second.
    pub time_scale: f64,
    /// Scheduling of the loop's thread, or why it is not real-time.
    pub scheduling: String,
    /// True if the bench's memory was locked.
    pub memory_locked: bool,
    pub periods: u64,
    /// Control instants at which the bench was too late.
    pub overruns: u64,
    pub skipped: u64,
    /// Samples without an answer in time; if the target paces, also periods without a tick.
    pub missed_replies: u64,
    /// Samples without an answer at the end of the trial.
    #[serde(default)]
    pub lost_replies: u64,
    pub rejected_frames: u64,
    pub lost_rows: u64,
    /// Delay of a sample after its deadline, µs.
    pub lateness_us: Quantiles,
    /// From control instant to actuation, µs of plate time; `None` without an answer.
    pub loop_delay_us: Option<Quantiles>,
    /// Longest constant delay at which the law settles on the nominal plate, µs of plate time.
    pub loop_delay_budget_us: Option<f64>,
    /// Deviation of the target's clock from the bench's, positive if fast; `None` if unknown.
    pub target_clock_ppm: Option<f64>,
    pub target_clock_error_ppm: Option<f64>,
    pub safe_confirmed: bool,
    /// Time that the hypervisor took from this machine's processors during the trial, ms; `None` if unknown.
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
