//! The scenario file as serde reads it: every key that it may have, none of them checked yet.

use crate::load::{LARGEST_SPREAD_PERCENT, LONGEST_PERIOD_MS, MOST_TRIALS};
use platebench_plate::RawProfile;
use schemars::JsonSchema;
use serde::Deserialize;
use std::path::PathBuf;

/// A scenario file.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawScenario {
    /// One line that says what is played.
    #[schemars(length(min = 1))]
    pub title: String,
    /// Where it comes from, such as a figure of the paper.
    #[serde(default)]
    pub source: Option<String>,
    /// Plate file, relative to this file.
    pub plate: PathBuf,
    /// Length of a trial, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub duration_ms: f64,
    /// Words to select scenarios by.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Largest spacing of trace rows, ms.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub trace_step_ms: Option<f64>,
    /// Which tier of the plate to run; `auto` where not given.
    #[serde(default)]
    #[schemars(schema_with = "crate::schema::models")]
    pub model: Option<String>,
    /// For scenarios that show a limit: the exit code that they must end with.
    #[serde(default)]
    #[schemars(extend("enum" = [1, 3, 5]))]
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
    #[schemars(length(min = 1))]
    pub expect: Vec<RawExpectation>,
}

impl RawScenario {
    /// The files that it names, in the order in which they are read.
    pub(crate) fn files(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let RawProfiles { setpoint_um, temperature_offset_k, finger_force_n } = &mut self.profile;
        let profiles = [setpoint_um, temperature_offset_k, finger_force_n].into_iter();
        std::iter::once(&mut self.plate).chain(profiles.filter_map(RawProfile::file_name_mut))
    }
}

/// `[controller]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawController {
    /// Control law by name; `--law` overrides it.
    #[schemars(length(min = 1))]
    pub law: Option<String>,
    /// Control period, ms.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = LONGEST_PERIOD_MS))]
    pub period_ms: Option<f64>,
    /// Excitation frequency at the start, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub start_frequency_hz: Option<f64>,
    /// Sampling to actuation, ms.
    #[schemars(range(min = 0.0))]
    pub loop_delay_ms: f64,
    /// Loop delay that the law is told of and designs for, ms.
    #[schemars(range(min = 0.0))]
    pub design_delay_ms: f64,
    /// Design value of the 5 % response time, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub response_time_ms: Option<f64>,
    /// The excitation frequency stays within this much of the start frequency, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub frequency_range_hz: Option<f64>,
    /// The excitation frequency moves at most this much per period, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub frequency_slew_hz: Option<f64>,
    /// Gains instead of the law's own design.
    pub gains: Option<RawGains>,
}

/// `[controller.gains]`
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawTrials {
    /// How many.
    #[schemars(range(min = 1, max = MOST_TRIALS))]
    pub count: i64,
    /// Up to how many, where a verdict needs more.
    #[schemars(range(min = 1, max = MOST_TRIALS))]
    pub max_count: Option<i64>,
    /// Seed of the first trial; each further one has the next number.
    #[schemars(range(min = 0))]
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
#[derive(Debug, Clone, Copy, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawSpread {
    /// Of the plate's gain K1, percent.
    #[schemars(range(min = 0.0, max = LARGEST_SPREAD_PERCENT))]
    pub gain_percent: f64,
    /// Of the plate's time constant, percent.
    #[schemars(range(min = 0.0, max = LARGEST_SPREAD_PERCENT))]
    pub time_constant_percent: f64,
    /// Of the sensor's gain, percent.
    #[schemars(range(min = 0.0, max = LARGEST_SPREAD_PERCENT))]
    pub sensor_gain_percent: f64,
    /// Of the temperature, kelvin.
    #[schemars(range(min = 0.0, max = LARGEST_SPREAD_PERCENT))]
    pub temperature_k: f64,
}

/// `[[fault]]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(transform = crate::schema::faults)]
pub struct RawFault {
    /// What goes wrong.
    #[schemars(schema_with = "crate::schema::kinds")]
    pub kind: String,
    /// Start of the window, ms.
    #[schemars(range(min = 0.0))]
    pub from_ms: f64,
    /// End of the window, ms, no longer inside.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub until_ms: Option<f64>,
    /// Which way the messages go that it strikes.
    #[serde(default)]
    #[schemars(schema_with = "crate::schema::directions")]
    pub direction: Option<String>,
    /// It strikes each so many-th message.
    #[serde(default)]
    #[schemars(range(min = 1, max = u32::MAX))]
    pub every: Option<i64>,
    /// How long a message is held up, ms.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub delay_ms: Option<f64>,
    /// What the sensed components are multiplied with.
    #[serde(default)]
    pub factor: Option<f64>,
    /// Seed of what is left to chance.
    #[serde(default)]
    #[schemars(range(min = 0))]
    pub seed: Option<i64>,
    /// Configure a controller anew that stopped because of it.
    #[serde(default)]
    pub reconfigure: bool,
}

/// `[[expect]]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(transform = crate::schema::expectations)]
pub struct RawExpectation {
    /// The measured quantity.
    #[schemars(schema_with = "crate::schema::metrics")]
    pub metric: String,
    /// Name in report and JUnit, unique in the file; by default the metric, then `metric 2`, `metric 3`.
    #[serde(default)]
    pub name: Option<String>,
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
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub about: Option<f64>,
    /// How far from `about` a value may lie, percent of it.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub tolerance_percent: Option<f64>,
    /// The paper's value, shown beside ours.
    #[serde(default)]
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    #[serde(default)]
    pub requirement: Option<String>,
    /// Confidence at which a verdict over trials is made.
    #[serde(default)]
    #[schemars(range(min = 0.5), extend("exclusiveMaximum" = 1))]
    pub confidence: Option<f64>,
    /// What the trials come to: `each`, `mean` or `quantile`.
    #[serde(default)]
    #[schemars(schema_with = "crate::schema::overs")]
    pub over: Option<String>,
    /// Which quantile.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 1))]
    pub quantile: Option<f64>,
    /// Half width of the band around the setpoint, percent.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 100))]
    pub band_percent: Option<f64>,
    /// Start of the judged window, ms.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub from_ms: Option<f64>,
    /// End of the judged window, ms; by default the end of the trial, or the next setpoint step for settling and overshoot.
    #[serde(default)]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub until_ms: Option<f64>,
    /// Judge after each change of this profile, up to the next change of any profile.
    #[serde(default)]
    #[schemars(schema_with = "crate::schema::changing_profiles")]
    pub after: Option<String>,
    /// The window of a mean: its length at the end, or its two ends, ms.
    #[serde(default)]
    pub window_ms: Option<RawWindow>,
    /// Which column to look at.
    #[serde(default)]
    #[schemars(schema_with = "crate::schema::signals")]
    pub signal: Option<String>,
}

/// `window_ms`
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected a length in ms, counted back from the end, or [from_ms, to_ms]")]
pub enum RawWindow {
    /// The last so many ms.
    Last(#[schemars(extend("exclusiveMinimum" = 0))] f64),
    /// From, to.
    Between([f64; 2]),
}
