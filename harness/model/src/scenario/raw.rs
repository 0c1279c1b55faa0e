//! Defines the scenario file as serde reads it, before any check.

use crate::metrics::Metric;
use crate::scenario::definition::{AUTO_MODEL, MAX_TIMEOUT_S, MAX_TRIALS, ScenarioGains, Spread};
use crate::scenario::message::{MAX_MESSAGES, ScenarioMessage};
use crate::scenario::window::ChangingProfile;
use platebench_plate::{RawProfile, is_default};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

pub(crate) const MAX_BETWEEN: usize = 16;
const MAX_PERIOD_MS: f64 = 1_000.0;
/// Largest clock error. A UART misreads bytes at a larger one.
const MAX_DRIFT_PPM: f64 = 20_000.0;

pub(crate) const DEFAULT_LAW: &str = "dq-pi";
pub(crate) const DEFAULT_PERIOD_MS: f64 = 1.0;
/// The resonance of the paper's plate differs by 87 Hz between 24 and 33 °C (Fig. 14). The range is
/// nearly three times as large.
pub(crate) const DEFAULT_FREQUENCY_RANGE_HZ: f64 = 250.0;
/// More than 87 Hz, so the controller can correct this difference within one period.
pub(crate) const DEFAULT_FREQUENCY_SLEW_HZ: f64 = 100.0;
pub(crate) const DEFAULT_CONFIDENCE: f64 = 0.95;
pub(crate) const DEFAULT_BAND_PERCENT: f64 = 5.0;
pub(crate) const DEFAULT_TOLERANCE_PERCENT: f64 = 5.0;
pub(crate) const DEFAULT_QUANTILE: f64 = 0.95;
pub(crate) const DEFAULT_SIGNAL: &str = "amplitude_um";

#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawScenario {
    /// Title, one line.
    #[schemars(length(min = 1))]
    pub title: String,
    /// Source, such as a figure of the paper.
    pub source: Option<String>,
    /// Plate file, relative to this file.
    pub plate: PathBuf,
    /// Length of a trial, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub duration_ms: f64,
    /// Words to select scenarios by.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
    /// Largest time between two rows of the trace, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub trace_step_ms: Option<f64>,
    /// Model of the plate; `auto` by default.
    #[serde(default)]
    #[schemars(schema_with = "crate::scenario::schema::models", extend("default" = AUTO_MODEL))]
    pub model: Option<String>,
    /// Reason why `run` plays this scenario only if the file or its own folder is named, one line.
    #[schemars(length(min = 1))]
    pub only_if_named: Option<String>,
    /// Exit code that a scenario of a known limit must end with.
    #[schemars(extend("enum" = [1, 3, 5]))]
    pub expected_exit: Option<i64>,
    /// Wall time after which `run` ends the trials of this scenario, s. Default: no limit.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = MAX_TIMEOUT_S))]
    pub timeout_s: Option<f64>,
    /// The controller and its timing.
    #[serde(default, skip_serializing_if = "is_default")]
    pub controller: RawController,
    /// Setpoint and conditions.
    pub profile: RawProfiles,
    /// Number and spread of the trials.
    #[serde(default, skip_serializing_if = "is_default")]
    pub trials: RawTrials,
    /// Planned faults of line and sensor.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fault: Vec<RawFault>,
    /// Scenes that the same controller plays before every trial but the first. They are not judged.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = MAX_BETWEEN))]
    pub between: Vec<RawBetween>,
    /// Scene of every trial but the first. `trial_difference_um` compares its response with that of
    /// the first trial.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub other_trials: Option<RawOtherTrials>,
    /// Messages that the bench plays before every trial. `protocol_differences` compares the answers
    /// with those of the reference.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = MAX_MESSAGES))]
    pub message: Vec<ScenarioMessage>,
    /// Expectations; at least one.
    #[serde(default)]
    #[schemars(length(min = 1))]
    pub expect: Vec<RawExpectation>,
    /// Cases of the file. `{name}` in a text stands for a value of the case.
    #[serde(default, skip_serializing)]
    #[schemars(schema_with = "crate::scenario::schema::matrix")]
    pub matrix: Option<toml::Table>,
}

impl RawScenario {
    /// The files that the scenario names, in the order in which they are read.
    pub(crate) fn files(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let own = scene_files(Some(&mut self.plate), &mut self.controller, &mut self.profile);
        let between = self.between.iter_mut();
        let others = self.other_trials.iter_mut();
        own.chain(
            between.flat_map(|scene| scene_files(scene.plate.as_mut(), &mut scene.controller, &mut scene.profile)),
        )
        .chain(others.flat_map(|scene| scene_files(scene.plate.as_mut(), &mut scene.controller, &mut scene.profile)))
    }
}

fn scene_files<'a>(
    plate: Option<&'a mut PathBuf>,
    controller: &'a mut RawController,
    profiles: &'a mut RawProfiles,
) -> impl Iterator<Item = &'a mut PathBuf> {
    let RawProfiles { setpoint_um, temperature_offset_k, finger_force_n } = profiles;
    let profiles = [setpoint_um, temperature_offset_k, finger_force_n].into_iter();
    let plates = plate.into_iter().chain(&mut controller.design_plate);
    plates.chain(profiles.filter_map(RawProfile::file_name_mut))
}

#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawBetween {
    /// Plate file, relative to this file. Default: the plate of the scenario.
    pub plate: Option<PathBuf>,
    /// Length of the scene, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub duration_ms: f64,
    /// The controller and its timing, independent of the scenario's.
    #[serde(default, skip_serializing_if = "is_default")]
    pub controller: RawController,
    /// Setpoint and conditions.
    pub profile: RawProfiles,
}

#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawOtherTrials {
    /// Plate file, relative to this file. Default: the plate of the scenario.
    pub plate: Option<PathBuf>,
    /// The amplitude is expected to be this factor times that of the first trial.
    #[serde(default = "one")]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub amplitude_factor: f64,
    /// The response is expected to be later than that of the first trial by this time, ms.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub later_ms: f64,
    /// The controller and its timing, independent of the scenario's.
    #[serde(default, skip_serializing_if = "is_default")]
    pub controller: RawController,
    /// Setpoint and conditions.
    pub profile: RawProfiles,
}

const fn one() -> f64 {
    1.0
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawController {
    /// Control law by name; `--law` overrides it.
    #[schemars(length(min = 1), extend("default" = DEFAULT_LAW))]
    pub law: Option<String>,
    /// Control period, ms.
    #[schemars(extend("exclusiveMinimum" = 0, "default" = DEFAULT_PERIOD_MS), range(max = MAX_PERIOD_MS))]
    pub period_ms: Option<f64>,
    /// Excitation frequency at the start, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub start_frequency_hz: Option<f64>,
    /// Time from sampling to actuation, ms.
    #[schemars(range(min = 0.0))]
    pub loop_delay_ms: f64,
    /// Largest additional loop delay, ms. Each period draws one, uniformly from 0 to this value, by
    /// the trial's seed.
    #[schemars(range(min = 0.0))]
    pub loop_delay_jitter_ms: f64,
    /// Loop delay that the law is designed for, ms.
    #[schemars(range(min = 0.0))]
    pub design_delay_ms: f64,
    /// Design value of the 5 % response time, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub response_time_ms: Option<f64>,
    /// Largest distance of the excitation frequency from the start frequency, Hz.
    #[schemars(extend("exclusiveMinimum" = 0, "default" = DEFAULT_FREQUENCY_RANGE_HZ))]
    pub frequency_range_hz: Option<f64>,
    /// Largest change of the excitation frequency per period, Hz.
    #[schemars(extend("exclusiveMinimum" = 0, "default" = DEFAULT_FREQUENCY_SLEW_HZ))]
    pub frequency_slew_hz: Option<f64>,
    /// Gains instead of the law's own design.
    pub gains: Option<ScenarioGains>,
    /// Plate file that the controller is configured for, relative to this file. Default: the plate
    /// of the scenario.
    pub design_plate: Option<PathBuf>,
}

#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawProfiles {
    /// Setpoint of the amplitude, µm.
    pub setpoint_um: RawProfile,
    /// Temperature above the plate's reference temperature, K.
    #[serde(default = "zero", skip_serializing_if = "RawProfile::is_zero")]
    pub temperature_offset_k: RawProfile,
    /// Normal force of the finger, N.
    #[serde(default = "zero", skip_serializing_if = "RawProfile::is_zero")]
    pub finger_force_n: RawProfile,
}

fn zero() -> RawProfile {
    RawProfile::Number(0.0)
}

/// Keys of a table that differ from their defaults.
pub(crate) fn keys_of(raw: &impl Serialize) -> Vec<String> {
    toml::Table::try_from(raw).map_or_else(|_| Vec::new(), |table| table.into_iter().map(|(key, _)| key).collect())
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawTrials {
    /// Number of trials.
    #[schemars(range(min = 1, max = MAX_TRIALS))]
    pub count: i64,
    /// Largest number of trials, if a verdict needs more.
    #[schemars(range(min = 1, max = MAX_TRIALS))]
    pub max_count: Option<i64>,
    /// Seed of the first trial. Each further trial has the next number.
    #[schemars(range(min = 0))]
    pub seed: i64,
    /// Differences between trials.
    #[serde(skip_serializing_if = "is_default")]
    pub spread: Spread,
}

impl Default for RawTrials {
    fn default() -> Self {
        Self { count: 1, max_count: None, seed: 1, spread: Spread::default() }
    }
}

/// Kind of a `[[fault]]` with its other keys.
pub(crate) struct FaultKeys {
    pub(crate) kind: &'static str,
    pub(crate) required: &'static [&'static str],
    pub(crate) optional: &'static [&'static str],
}

impl FaultKeys {
    pub(crate) fn all(&self) -> impl Iterator<Item = &'static str> {
        self.required.iter().chain(self.optional).copied()
    }
}

const fn fault(kind: &'static str, required: &'static [&'static str], optional: &'static [&'static str]) -> FaultKeys {
    FaultKeys { kind, required, optional }
}

const WINDOW: &[&str] = &["from_ms", "until_ms"];
const ON_LINE: &[&str] = &["direction", "every", "reconfigure"];
const INSTANT: &[&str] = &["at_ms", "random"];

/// `None` for an unknown kind.
pub(crate) fn fault_keys(kind: &str) -> Option<&'static FaultKeys> {
    FAULT_KEYS.iter().find(|keys| keys.kind == kind)
}

pub(crate) const FAULT_KEYS: [FaultKeys; 15] = [
    fault("drop", WINDOW, ON_LINE),
    fault("flip", WINDOW, &["direction", "every", "reconfigure", "seed"]),
    fault("duplicate", WINDOW, ON_LINE),
    fault("delay", &["from_ms", "until_ms", "delay_ms"], ON_LINE),
    fault("truncate", WINDOW, ON_LINE),
    fault("babble", WINDOW, &["direction", "every", "reconfigure", "seed"]),
    fault("disconnect", &["from_ms"], &["until_ms", "direction", "reconfigure"]),
    fault("freeze", WINDOW, &["every", "reconfigure"]),
    fault("scale", &["from_ms", "until_ms", "factor"], &["every", "reconfigure"]),
    fault("bit-flip", &["target"], &["at_ms", "random", "bit"]),
    fault("reset", &[], INSTANT),
    fault("power-cut", &[], INSTANT),
    fault("clock-drift", &["ppm"], INSTANT),
    fault("hang", &[], INSTANT),
    fault("stuck", &["target", "value"], INSTANT),
];

#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(transform = crate::scenario::schema::faults)]
pub struct RawFault {
    /// Kind of fault.
    #[schemars(schema_with = "crate::scenario::schema::kinds")]
    pub kind: String,
    /// Start of the window in which the fault acts, ms.
    #[schemars(range(min = 0.0))]
    pub from_ms: Option<f64>,
    /// End of the window in which the fault acts, exclusive, ms. Only `disconnect` may last until
    /// the end of the trial.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub until_ms: Option<f64>,
    /// Direction of the messages that the fault acts on.
    #[serde(default)]
    #[schemars(schema_with = "crate::scenario::schema::directions")]
    pub direction: Option<String>,
    /// The fault acts on every n-th message of each direction.
    #[schemars(range(min = 1, max = u32::MAX))]
    pub every: Option<i64>,
    /// Delay of a message, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub delay_ms: Option<f64>,
    /// Factor on the sensed components Wd and Wq.
    pub factor: Option<f64>,
    /// Seed of random effects.
    #[schemars(range(min = 0))]
    pub seed: Option<i64>,
    /// Configures the controller again after the window if the fault stopped it.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(extend("default" = false))]
    pub reconfigure: bool,
    /// Instant of a fault of the chip, ms.
    #[schemars(range(min = 0.0))]
    pub at_ms: Option<f64>,
    /// Draws the instant of a fault of the chip from the trial's seed.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(extend("default" = false))]
    pub random: bool,
    /// Place of a fault of the chip: `ram:START+LENGTH`, `variable:NAME`, `register:NAME` or
    /// `peripheral:ADDRESS`.
    pub target: Option<String>,
    /// Number of the flipped bit from the start of the target. Default: drawn from the trial's
    /// seed.
    #[schemars(range(min = 0))]
    pub bit: Option<i64>,
    /// Value that every read of a stuck register returns.
    #[schemars(range(min = 0, max = u32::MAX))]
    pub value: Option<i64>,
    /// Frequency error of the chip's clocks, positive if fast, parts per million; not 0.
    #[schemars(range(min = -MAX_DRIFT_PPM, max = MAX_DRIFT_PPM))]
    pub ppm: Option<f64>,
}

/// A key of `[[expect]]`, the metrics that it applies to, and whether an expectation has it.
type MetricKey = (&'static str, fn(Metric) -> bool, fn(&RawExpectation) -> bool);

/// Keys of an `[[expect]]` that apply to some metrics only.
pub(crate) const METRIC_KEYS: [MetricKey; 10] = [
    ("band_percent", Metric::has_band, |raw| raw.band_percent.is_some()),
    ("from_ms", Metric::has_from_ms, |raw| raw.from_ms.is_some()),
    ("until_ms", Metric::has_from_ms, |raw| raw.until_ms.is_some()),
    ("after", has_any_after, |raw| raw.after.is_some()),
    ("window_ms", Metric::has_window_ms, |raw| raw.window_ms.is_some()),
    ("signal", Metric::has_signal, |raw| raw.signal.is_some()),
    ("text", Metric::has_text, |raw| raw.text.is_some()),
    ("tolerance_percent", Metric::has_over, |raw| raw.tolerance_percent.is_some()),
    ("over", Metric::has_over, |raw| raw.over.is_some()),
    ("quantile", Metric::has_over, |raw| raw.quantile.is_some()),
];

fn has_any_after(metric: Metric) -> bool {
    ChangingProfile::ALL.into_iter().any(|profile| profile.applies_to(metric))
}

#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(transform = crate::scenario::schema::expectations)]
pub struct RawExpectation {
    /// The measured quantity.
    #[schemars(schema_with = "crate::scenario::schema::metrics")]
    pub metric: String,
    /// Name in reports, unique in the file. Default: the metric, numbered from its second
    /// expectation: `ripple_um 2`.
    pub name: Option<String>,
    /// Upper limit.
    pub at_most: Option<f64>,
    /// Lower limit.
    pub at_least: Option<f64>,
    /// Lower and upper limit.
    pub within: Option<[f64; 2]>,
    /// Expected value.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub about: Option<f64>,
    /// Tolerance around `about`, percent of it.
    #[schemars(extend("exclusiveMinimum" = 0, "default" = DEFAULT_TOLERANCE_PERCENT))]
    pub tolerance_percent: Option<f64>,
    /// The paper's value, for comparison.
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    pub requirement: Option<String>,
    /// Confidence of a verdict over trials.
    #[schemars(range(min = 0.5), extend("exclusiveMaximum" = 1, "default" = DEFAULT_CONFIDENCE))]
    pub confidence: Option<f64>,
    /// Statistic over trials: `each`, `mean` or `quantile`.
    #[serde(default)]
    #[schemars(schema_with = "crate::scenario::schema::overs")]
    pub over: Option<String>,
    /// Quantile as a share of the trials, for `over = "quantile"`.
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 1, "default" = DEFAULT_QUANTILE))]
    pub quantile: Option<f64>,
    /// Half width of the band around the setpoint, percent of the setpoint.
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 100, "default" = DEFAULT_BAND_PERCENT))]
    pub band_percent: Option<f64>,
    /// Start of the judged window, ms.
    #[schemars(range(min = 0.0))]
    pub from_ms: Option<f64>,
    /// End of the judged window, ms. Default: the end of the trial, or the next step of the
    /// setpoint.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub until_ms: Option<f64>,
    /// Judges after each change of this profile, until the next change of any profile.
    #[serde(default)]
    #[schemars(schema_with = "crate::scenario::schema::changing_profiles")]
    pub after: Option<String>,
    /// Window of a mean or a ripple, ms. Either its length at the end of the trial, or its start
    /// and end.
    pub window_ms: Option<RawWindow>,
    /// Column of the trace that is judged.
    #[serde(default)]
    #[schemars(schema_with = "crate::scenario::schema::signals", extend("default" = DEFAULT_SIGNAL))]
    pub signal: Option<String>,
    /// Text that the firmware writes, for `text_ms`.
    #[schemars(length(min = 1))]
    pub text: Option<String>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected a length in ms, counted back from the end, or [from_ms, to_ms]")]
pub enum RawWindow {
    Last(#[schemars(extend("exclusiveMinimum" = 0))] f64),
    Between([f64; 2]),
}
