//! The scenario file as serde reads it: every key that it may have, none of them checked yet.

use platebench_plate::profile::RawProfile;
use serde::Deserialize;
use std::path::PathBuf;

/// A scenario file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawScenario {
    /// One line that says what is played.
    pub title: String,
    /// Where it comes from, such as a figure of the paper.
    #[serde(default)]
    pub source: Option<String>,
    /// Plate file, relative to this file.
    pub plate: PathBuf,
    /// Length of a trial, ms.
    pub duration_ms: f64,
    /// Words to select scenarios by.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Largest spacing of trace rows, ms.
    #[serde(default)]
    pub trace_step_ms: Option<f64>,
    /// Which tier of the plate to run; `auto` where not given.
    #[serde(default)]
    pub model: Option<String>,
    /// For scenarios that show a limit: the exit code that they must end with.
    #[serde(default)]
    pub expected_exit: Option<i64>,
    /// The controller and its timing.
    #[serde(default)]
    pub controller: RawController,
    /// What is played.
    pub profile: RawProfiles,
    /// How often, and what differs from trial to trial.
    #[serde(default)]
    pub trials: RawTrials,
    /// What goes wrong on the line to the controller.
    #[serde(default)]
    pub fault: Vec<RawFault>,
    /// What is expected.
    #[serde(default)]
    pub expect: Vec<RawExpectation>,
}

/// `[controller]`
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawController {
    /// Control law by name; `--law` overrides it.
    pub law: Option<String>,
    /// Control period, ms.
    pub period_ms: Option<f64>,
    /// Excitation frequency at the start, Hz.
    pub start_frequency_hz: Option<f64>,
    /// Sampling to actuation, ms.
    pub loop_delay_ms: f64,
    /// Loop delay that the law is told of and designs for, ms.
    pub design_delay_ms: f64,
    /// Design value of the 5 % response time, ms.
    pub response_time_ms: Option<f64>,
    /// The excitation frequency stays within this much of the start frequency, Hz.
    pub frequency_range_hz: Option<f64>,
    /// The excitation frequency moves at most this much per period, Hz.
    pub frequency_slew_hz: Option<f64>,
    /// Gains instead of the law's own design.
    pub gains: Option<RawGains>,
}

/// `[controller.gains]`
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawGains {
    /// Amplitude loop, Vpp per µm.
    pub amplitude_kp: f64,
    /// Amplitude loop, Vpp per µm and second.
    pub amplitude_ki: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd.
    pub frequency_kp: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd and second.
    pub frequency_ki: f64,
}

/// `[profile]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawProfiles {
    /// Wished amplitude, µm.
    pub setpoint_um: RawProfile,
    /// Kelvin above the plate's reference temperature.
    #[serde(default = "zero")]
    pub temperature_offset_k: RawProfile,
    /// Normal force of the finger, N.
    #[serde(default = "zero")]
    pub finger_force_n: RawProfile,
}

fn zero() -> RawProfile {
    RawProfile::Number(0.0)
}

/// `[trials]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawTrials {
    /// How many.
    pub count: i64,
    /// Up to how many, where a verdict needs more.
    pub max_count: Option<i64>,
    /// Seed of the first trial; each further one has the next number.
    pub seed: i64,
    /// What differs from trial to trial.
    pub spread: RawSpread,
}

impl Default for RawTrials {
    fn default() -> Self {
        Self { count: 1, max_count: None, seed: 1, spread: RawSpread::default() }
    }
}

/// `[trials.spread]`: standard deviations.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawSpread {
    /// Of the plate's gain K1, percent.
    pub gain_percent: f64,
    /// Of the plate's time constant, percent.
    pub time_constant_percent: f64,
    /// Of the sensor's gain, percent.
    pub sensor_gain_percent: f64,
    /// Of the temperature, kelvin.
    pub temperature_k: f64,
}

/// `[[fault]]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFault {
    /// What goes wrong.
    pub kind: String,
    /// Start of the window, ms.
    pub from_ms: f64,
    /// End of the window, ms, no longer inside.
    #[serde(default)]
    pub until_ms: Option<f64>,
    /// Which way the messages go that it strikes.
    #[serde(default)]
    pub direction: Option<String>,
    /// It strikes each so many-th message.
    #[serde(default)]
    pub every: Option<i64>,
    /// How long a message is held up, ms.
    #[serde(default)]
    pub delay_ms: Option<f64>,
    /// What the sensed components are multiplied with.
    #[serde(default)]
    pub factor: Option<f64>,
    /// Seed of what is left to chance.
    #[serde(default)]
    pub seed: Option<i64>,
    /// Configure a controller anew that stopped because of it.
    #[serde(default)]
    pub reconfigure: bool,
}

/// `[[expect]]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawExpectation {
    /// What is measured.
    pub metric: String,
    /// Upper limit.
    #[serde(default)]
    pub at_most: Option<f64>,
    /// Lower limit.
    #[serde(default)]
    pub at_least: Option<f64>,
    /// Both limits.
    #[serde(default)]
    pub within: Option<[f64; 2]>,
    /// A value to agree with.
    #[serde(default)]
    pub about: Option<f64>,
    /// How far from `about` a value may lie, percent of it.
    #[serde(default)]
    pub tolerance_percent: Option<f64>,
    /// The paper's value, shown beside ours.
    #[serde(default)]
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    #[serde(default)]
    pub requirement: Option<String>,
    /// Confidence at which a verdict over trials is made.
    #[serde(default)]
    pub confidence: Option<f64>,
    /// What the trials come to: `each`, `mean` or `quantile`.
    #[serde(default)]
    pub over: Option<String>,
    /// Which quantile.
    #[serde(default)]
    pub quantile: Option<f64>,
    /// Half width of the band around the setpoint, percent.
    #[serde(default)]
    pub band_percent: Option<f64>,
    /// From when on to look, ms.
    #[serde(default)]
    pub from_ms: Option<f64>,
    /// The window of a mean: its length at the end, or its two ends, ms.
    #[serde(default)]
    pub window_ms: Option<RawWindow>,
    /// Which column to look at.
    #[serde(default)]
    pub signal: Option<String>,
}

/// `window_ms`
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "expected a length in ms, counted back from the end, or [from_ms, to_ms]")]
pub enum RawWindow {
    /// The last so many ms.
    Last(f64),
    /// From, to.
    Between([f64; 2]),
}
