//! Defines metrics, limits and expectations.

use crate::scenario::window::{ChangingProfile, Window};
use platebench_plate::Time;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// A quantity that is measured in a trial or over trials. Definitions: `docs/verdicts.md`.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    strum::VariantArray,
    strum::VariantNames,
    strum::Display,
    strum::IntoStaticStr,
)]
#[strum(const_into_str, serialize_all = "snake_case")]
pub enum Metric {
    /// Time from the setpoint step to the last entry into the band.
    #[strum(serialize = "settling_time_ms")]
    SettlingTime,
    /// |mean over the window − setpoint| / setpoint.
    #[strum(serialize = "static_error_percent")]
    StaticError,
    /// Standard deviation over trials of the window's mean, relative to the setpoint.
    #[strum(serialize = "repeatability_percent")]
    Repeatability,
    /// Largest excess over the setpoint, relative to the step.
    #[strum(serialize = "overshoot_percent")]
    Overshoot,
    /// Largest distance from the setpoint in the window, relative to the setpoint.
    #[strum(serialize = "peak_deviation_percent")]
    PeakDeviation,
    /// Time from a disturbance to the last entry into the band.
    #[strum(serialize = "recovery_time_ms")]
    RecoveryTime,
    /// |excitation frequency − resonance| at the end of the window.
    #[strum(serialize = "frequency_error_hz")]
    FrequencyError,
    /// |Wq/Wd| at the end of the window.
    QuadratureRatio,
    /// |W| at the end of the window.
    #[strum(serialize = "final_amplitude_um")]
    FinalAmplitude,
    /// Largest drive in the window.
    #[strum(serialize = "drive_peak_vpp")]
    DrivePeak,
    /// Share of the time with the drive at the limit of the amplifier.
    #[strum(serialize = "saturated_percent")]
    Saturated,
    /// Longest time from sampling to actuation in the trial.
    #[strum(serialize = "loop_delay_us")]
    LoopDelay,
    /// Largest number of instructions per control step in the trial.
    InstructionsPerStep,
    /// Longest control step in the trial on the emulated chip, relative to the control period.
    #[strum(serialize = "step_time_percent")]
    StepTime,
    /// Number of control instants at which the bench was too late.
    Overruns,
    /// Time from a disturbance to 0 V.
    #[strum(serialize = "shutdown_time_ms")]
    ShutdownTime,
    /// Number of control instants without an answer.
    MissedReplies,
    /// Largest minus smallest value of the signal over the window, relative to the setpoint.
    RipplePercent,
    /// Largest minus smallest value of the signal over the window.
    #[strum(serialize = "ripple_um")]
    Ripple,
    /// Largest drive while the setpoint is 0, from one period and loop delay after it became 0.
    #[strum(serialize = "rest_drive_vpp")]
    RestDrive,
    /// Largest difference of the signal from the first trial at the same control instant.
    #[strum(serialize = "trial_difference_um")]
    TrialDifference,
    /// Largest difference between a command and that of the reference implementation for the same
    /// samples, as a share of the drive limit or of the frequency range.
    #[strum(serialize = "reference_difference_percent")]
    ReferenceDifference,
    /// Number of message scripts that the controller answers differently from the reference
    /// implementation.
    ProtocolDifferences,
}

impl Metric {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;
    pub const NAMES: &[&str] = <Self as strum::VariantNames>::VARIANTS;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|metric| metric.name() == name)
    }

    pub const fn value_range(self) -> (f64, f64) {
        match self {
            Self::Saturated => (0.0, 100.0),
            _ => (0.0, f64::INFINITY),
        }
    }

    pub const fn has_band(self) -> bool {
        matches!(self, Self::SettlingTime | Self::RecoveryTime | Self::PeakDeviation)
    }

    pub const fn has_window_ms(self) -> bool {
        matches!(self, Self::StaticError | Self::Repeatability | Self::RipplePercent | Self::Ripple)
    }

    /// True if the keys `from_ms` and `until_ms` apply. The other metrics cover the whole trial.
    pub const fn has_from_ms(self) -> bool {
        !matches!(
            self,
            Self::LoopDelay
                | Self::InstructionsPerStep
                | Self::StepTime
                | Self::ReferenceDifference
                | Self::ProtocolDifferences
        )
    }

    pub const fn is_step_response(self) -> bool {
        matches!(self, Self::SettlingTime | Self::Overshoot)
    }

    pub const fn is_relative_to_setpoint(self) -> bool {
        self.has_band() || matches!(self, Self::StaticError | Self::Repeatability | Self::RipplePercent)
    }

    pub fn has_after(self, profile: ChangingProfile) -> bool {
        match self {
            Self::LoopDelay
            | Self::InstructionsPerStep
            | Self::StepTime
            | Self::ReferenceDifference
            | Self::ProtocolDifferences
            | Self::ShutdownTime
            | Self::Repeatability
            | Self::RestDrive
            | Self::TrialDifference => false,
            _ if self.is_step_response() => profile == ChangingProfile::Setpoint,
            _ => true,
        }
    }

    /// True if the key `over` (statistic over trials) applies. The others compare trials already.
    pub const fn has_over(self) -> bool {
        !matches!(self, Self::Repeatability | Self::TrialDifference)
    }

    /// True if the metric depends on the motion of the plate, not only on messages and timing.
    pub const fn is_of_the_plate(self) -> bool {
        !matches!(
            self,
            Self::LoopDelay
                | Self::InstructionsPerStep
                | Self::StepTime
                | Self::ReferenceDifference
                | Self::ProtocolDifferences
                | Self::Overruns
                | Self::ShutdownTime
                | Self::MissedReplies
        )
    }

    pub const fn has_signal(self) -> bool {
        self.has_band() || self.has_window_ms() || matches!(self, Self::Overshoot | Self::TrialDifference)
    }
}

impl JsonSchema for Metric {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Metric".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "enum": Self::NAMES })
    }
}

impl Serialize for Metric {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Metric {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::from_name(&name).ok_or_else(|| D::Error::custom(format!("unknown metric `{name}`")))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Limit {
    AtMost(f64),
    AtLeast(f64),
    Within(f64, f64),
    /// Within the tolerance of the expectation around this value.
    About(f64),
}

impl Limit {
    /// Smallest and largest permitted value. Only [`Self::About`] uses `tolerance_percent`.
    pub fn range(self, tolerance_percent: f64) -> (f64, f64) {
        match self {
            Self::AtMost(high) => (f64::NEG_INFINITY, high),
            Self::AtLeast(low) => (low, f64::INFINITY),
            Self::Within(low, high) => (low, high),
            Self::About(value) => {
                let margin = value.abs() * tolerance_percent / 100.0;
                (value - margin, value + margin)
            }
        }
    }

    /// Distance of `value` from the limit, divided by a scale; negative if `value` breaks the
    /// limit. The scale is the limit itself, half of the range, or the tolerance. A scale of 0 is
    /// replaced by 1.
    pub fn margin(self, value: f64, tolerance_percent: f64) -> f64 {
        let over = |distance: f64, scale: f64| distance / if scale == 0.0 { 1.0 } else { scale.abs() };
        let (low, high) = self.range(tolerance_percent);
        match self {
            Self::AtMost(limit) => over(limit - value, limit),
            Self::AtLeast(limit) => over(value - limit, limit),
            Self::Within(..) | Self::About(_) => over((value - low).min(high - value), (high - low) / 2.0),
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtMost(high) => write!(formatter, "≤ {high}"),
            Self::AtLeast(low) => write!(formatter, "≥ {low}"),
            Self::Within(low, high) => write!(formatter, "{low} … {high}"),
            Self::About(value) => write!(formatter, "≈ {value}"),
        }
    }
}

/// The statistic over trials that is compared with the limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aggregation {
    Each,
    Mean,
    /// Quantile at this share of the trials, for example 0.95.
    Quantile(f64),
    StandardDeviation,
}

impl Aggregation {
    pub const NAMES: [&str; 3] = ["each", "mean", "quantile"];

    pub const fn default_for(metric: Metric) -> Self {
        match metric {
            Metric::Repeatability => Self::StandardDeviation,
            Metric::StaticError => Self::Mean,
            _ => Self::Each,
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Expectation {
    /// Unique name in the scenario. The default is the metric's name. From its second expectation
    /// on, a number follows: `ripple_um 2`.
    pub name: String,
    pub metric: Metric,
    pub limit: Limit,
    /// Tolerance of [`Limit::About`], percent of the value; not used for [`Metric::Repeatability`].
    pub tolerance_percent: f64,
    pub paper: Option<f64>,
    pub requirement: Option<String>,
    pub confidence: f64,
    pub aggregation: Aggregation,
    pub band_percent: f64,
    /// At least one, in rising order. The worst window decides. A mean is taken over each window.
    pub windows: Vec<Window>,
    pub after: Option<ChangingProfile>,
    pub from: Option<Time>,
    pub signal: &'static str,
}

/// Columns of the trace that an expectation can judge.
pub const SIGNALS: [&str; 5] = ["amplitude_um", "wd_um", "wq_um", "sensed_wd_um", "sensed_wq_um"];

impl Expectation {
    /// Measures the amplitude in `window`; a band is 5 % of the setpoint. The limit is arbitrary.
    pub fn for_window(metric: Metric, window: Window) -> Self {
        Self {
            name: metric.name().to_owned(),
            windows: vec![window],
            after: None,
            metric,
            limit: Limit::AtMost(0.0),
            tolerance_percent: 0.0,
            paper: None,
            requirement: None,
            confidence: 0.95,
            aggregation: Aggregation::default_for(metric),
            band_percent: 5.0,
            from: None,
            signal: SIGNALS[0],
        }
    }

    pub fn range(&self) -> (f64, f64) {
        self.limit.range(self.tolerance_percent)
    }

    /// Margin as in [`Limit::margin`]. `None` if a standard deviation is compared with
    /// [`Limit::About`], because that is a statistical test without a tolerance.
    pub fn margin(&self, value: f64) -> Option<f64> {
        let is_agreement = self.aggregation == Aggregation::StandardDeviation && matches!(self.limit, Limit::About(_));
        (!is_agreement).then(|| self.limit.margin(value, self.tolerance_percent))
    }

    pub fn holds(&self, value: f64) -> bool {
        let (low, high) = self.range();
        (low..=high).contains(&value)
    }

    /// Lower and upper edge of the band. Both belong to the band.
    pub fn band(&self, setpoint: f64) -> (f64, f64) {
        let half = setpoint.abs() * self.band_percent / 100.0;
        (setpoint - half, setpoint + half)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(Limit::AtMost(2.0), 1.5, 0.25)]
    #[case(Limit::AtMost(2.0), 3.0, -0.5)]
    #[case(Limit::AtMost(-2.0), -3.0, 0.5)]
    #[case(Limit::AtMost(0.0), 0.5, -0.5)]
    #[case(Limit::AtLeast(2.0), 3.0, 0.5)]
    #[case(Limit::AtLeast(0.0), 3.0, 3.0)]
    #[case(Limit::Within(1.0, 3.0), 2.0, 1.0)]
    #[case(Limit::Within(1.0, 3.0), 2.5, 0.5)]
    #[case(Limit::Within(1.0, 3.0), 0.5, -0.5)]
    #[case(Limit::Within(2.0, 2.0), 5.0, -3.0)]
    #[case(Limit::About(10.0), 10.5, 0.5)]
    #[case(Limit::About(10.0), 12.0, -1.0)]
    #[case(Limit::About(0.0), 2.0, -2.0)]
    fn a_margin_is_the_distance_over_the_scale(#[case] limit: Limit, #[case] value: f64, #[case] expected: f64) {
        assert!((limit.margin(value, 10.0) - expected).abs() < 1e-12, "{}", limit.margin(value, 10.0));
    }
}
