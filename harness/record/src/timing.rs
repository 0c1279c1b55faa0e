//! Records lateness and loop delay of a real-time trial.

use serde::{Deserialize, Serialize};

/// Lateness and loop delay of a real-time trial, in wall-clock time unless stated otherwise.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TimingRecord {
    /// Which timer makes the control instants: `bench` or `target`.
    pub pacing: String,
    /// Plate seconds per wall second.
    pub time_scale: f64,
    /// Scheduling of the loop's thread, or why it is not real-time.
    pub scheduling: String,
    /// True if the bench's memory was locked.
    pub memory_locked: bool,
    /// Control instants.
    pub periods: u64,
    /// Control instants at which the bench was too late.
    pub overruns: u64,
    /// Overruns of a whole period: the sample was not sent.
    pub skipped: u64,
    /// Samples without an answer before the next control instant; if the target paces, also periods
    /// without a tick.
    pub missed_replies: u64,
    /// Samples without an answer at the end of the trial.
    #[serde(default)]
    pub lost_replies: u64,
    /// Frames that were rejected.
    pub rejected_frames: u64,
    /// Rows that were lost between control loop and trace.
    pub lost_rows: u64,
    /// Delay of a sample after its deadline, µs.
    pub lateness_us: Quantiles,
    /// From control instant to actuation, as it acted on the plate, µs of plate time; `None`
    /// without an answer.
    pub loop_delay_us: Option<Quantiles>,
    /// Longest constant loop delay at which the law settles on the scenario's nominal plate, µs of
    /// plate time; `None` if unknown.
    pub loop_delay_budget_us: Option<f64>,
    /// Deviation of the target's clock from the bench's, positive if fast, parts per million;
    /// `None` if unknown.
    pub target_clock_ppm: Option<f64>,
    /// Standard error of `target_clock_ppm`.
    pub target_clock_error_ppm: Option<f64>,
    /// True if the controller confirmed 0 V at the end of the trial.
    pub safe_confirmed: bool,
}

/// Points of a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Quantiles {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Largest.
    pub max: f64,
}
