//! How a real-time trial kept its time.

use serde::{Deserialize, Serialize};

/// How punctual bench, line and controller were in a real-time trial. Times are the wall's unless said otherwise.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Timing {
    /// Whose timer made the control instants: `bench` or `target`.
    pub pacing: String,
    /// Plate seconds per wall second.
    pub time_scale: f64,
    /// How the loop's thread was scheduled, or why not better.
    pub scheduling: String,
    /// True where no page of the bench could be swapped out.
    pub memory_locked: bool,
    /// Control instants.
    pub periods: u64,
    /// Control instants for which the bench was too late.
    pub overruns: u64,
    /// Of these, so late that the next instant had come: the sample was not sent.
    pub skipped: u64,
    /// Samples that had no answer when the next control instant came; where the target paces, also periods without a tick.
    pub missed_replies: u64,
    /// Of all samples, those that had no answer by the end of the trial.
    #[serde(default)]
    pub lost_replies: u64,
    /// Frames that could not be read.
    pub refused_frames: u64,
    /// Rows that found no room on their way out of the loop.
    pub lost_rows: u64,
    /// How much later than its deadline a sample left the bench, µs.
    pub lateness_us: Quantiles,
    /// From the control instant to the actuation, as it acted on the plate: µs of plate time. `null` where no answer came.
    pub loop_delay_us: Option<Quantiles>,
    /// The longest constant loop delay, µs of plate time, at which the law still settles on this scenario's nominal plate; `null` where that is not known.
    pub loop_delay_budget_us: Option<f64>,
    /// How much faster than the bench's clock the target's runs, parts per million; `null` where too little was heard.
    pub target_clock_ppm: Option<f64>,
    /// Standard error of `target_clock_ppm`.
    pub target_clock_error_ppm: Option<f64>,
    /// True where the controller confirmed 0 V at the end of the trial.
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
