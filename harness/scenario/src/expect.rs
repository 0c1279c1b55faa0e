//! What is expected of a controller.

use platebench_plate::Time;
use std::fmt;

/// What can be measured in a trial or over trials. Definitions: `docs/verdicts.md`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Metric {
    /// From the setpoint step to the last entry into the band.
    SettlingTime,
    /// |mean over the window − setpoint| / setpoint.
    StaticError,
    /// Standard deviation over trials of the window's mean, relative to the setpoint.
    Repeatability,
    /// How far beyond the setpoint, relative to the step.
    Overshoot,
    /// Largest distance from the setpoint once the band was entered.
    PeakDeviation,
    /// From a disturbance to the last entry into the band.
    RecoveryTime,
    /// |excitation − resonance| at the end.
    FrequencyError,
    /// |Wq/Wd| at the end.
    QuadratureRatio,
    /// |W| at the end.
    FinalAmplitude,
    /// Highest drive.
    DrivePeak,
    /// Share of the time at the amplifier's limit.
    Saturated,
    /// Sampling to actuation.
    LoopDelay,
    /// Instructions that the target executed for a sample, worst of the trial.
    InstructionsPerStep,
    /// Instants for which the bench was too late.
    Overruns,
    /// From a disturbance to 0 V.
    ShutdownTime,
    /// Control instants without an answer.
    MissedReplies,
}

impl Metric {
    /// Every metric.
    pub const ALL: [Self; 16] = [
        Self::SettlingTime,
        Self::StaticError,
        Self::Repeatability,
        Self::Overshoot,
        Self::PeakDeviation,
        Self::RecoveryTime,
        Self::FrequencyError,
        Self::QuadratureRatio,
        Self::FinalAmplitude,
        Self::DrivePeak,
        Self::Saturated,
        Self::LoopDelay,
        Self::InstructionsPerStep,
        Self::Overruns,
        Self::ShutdownTime,
        Self::MissedReplies,
    ];

    /// The metric's name in scenario files and records, with its unit.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SettlingTime => "settling_time_ms",
            Self::StaticError => "static_error_percent",
            Self::Repeatability => "repeatability_percent",
            Self::Overshoot => "overshoot_percent",
            Self::PeakDeviation => "peak_deviation_percent",
            Self::RecoveryTime => "recovery_time_ms",
            Self::FrequencyError => "frequency_error_hz",
            Self::QuadratureRatio => "quadrature_ratio",
            Self::FinalAmplitude => "final_amplitude_um",
            Self::DrivePeak => "drive_peak_vpp",
            Self::Saturated => "saturated_percent",
            Self::LoopDelay => "loop_delay_us",
            Self::InstructionsPerStep => "instructions_per_step",
            Self::Overruns => "overruns",
            Self::ShutdownTime => "shutdown_time_ms",
            Self::MissedReplies => "missed_replies",
        }
    }

    /// The metric of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|metric| metric.name() == name)
    }

    /// The smallest and the largest value that it can take.
    pub const fn possible(self) -> (f64, f64) {
        match self {
            Self::Saturated => (0.0, 100.0),
            _ => (0.0, f64::INFINITY),
        }
    }

    /// True where a band around the setpoint is part of the definition.
    pub const fn has_band(self) -> bool {
        matches!(self, Self::SettlingTime | Self::RecoveryTime | Self::PeakDeviation)
    }

    /// True where a window's mean is part of the definition.
    pub const fn has_window(self) -> bool {
        matches!(self, Self::StaticError | Self::Repeatability)
    }

    /// True where an instant to look from is part of the definition.
    pub const fn has_from(self) -> bool {
        matches!(
            self,
            Self::SettlingTime | Self::Overshoot | Self::PeakDeviation | Self::RecoveryTime | Self::ShutdownTime
        )
    }

    /// True where the signal can be chosen.
    pub const fn has_signal(self) -> bool {
        self.has_band() || self.has_window() || matches!(self, Self::Overshoot)
    }
}

impl fmt::Display for Metric {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// What a metric is held against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// Not above.
    AtMost(f64),
    /// Not below.
    AtLeast(f64),
    /// Between both, inclusive.
    Within(f64, f64),
    /// Agreement with a value, to a tolerance in percent of it where one is meaningful.
    About {
        /// The value.
        value: f64,
        /// Percent of the value.
        tolerance_percent: f64,
    },
}

impl Limit {
    /// The smallest and the largest value that are still good.
    pub fn range(self) -> (f64, f64) {
        match self {
            Self::AtMost(high) => (f64::NEG_INFINITY, high),
            Self::AtLeast(low) => (low, f64::INFINITY),
            Self::Within(low, high) => (low, high),
            Self::About { value, tolerance_percent } => {
                let margin = value.abs() * tolerance_percent / 100.0;
                (value - margin, value + margin)
            }
        }
    }

    /// True where `value` is good.
    pub fn holds(self, value: f64) -> bool {
        let (low, high) = self.range();
        (low..=high).contains(&value)
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtMost(high) => write!(formatter, "≤ {high}"),
            Self::AtLeast(low) => write!(formatter, "≥ {low}"),
            Self::Within(low, high) => write!(formatter, "{low} … {high}"),
            Self::About { value, .. } => write!(formatter, "≈ {value}"),
        }
    }
}

/// What the trials of a scenario come to, before it is held against the limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Over {
    /// Each trial has to keep the limit by itself.
    Each,
    /// Their mean has to.
    Mean,
    /// That share of all trials lies at or below what has to.
    Quantile(f64),
    /// Their standard deviation has to; only [`Metric::Repeatability`].
    Deviation,
}

impl Over {
    /// Names in scenario files.
    pub const NAMES: [&str; 3] = ["each", "mean", "quantile"];

    /// What a metric comes to unless the scenario says otherwise.
    pub const fn default_of(metric: Metric) -> Self {
        match metric {
            Metric::Repeatability => Self::Deviation,
            Metric::StaticError => Self::Mean,
            _ => Self::Each,
        }
    }
}

/// The stretch of a trial over which a mean is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// Its start.
    pub from: Time,
    /// Its end.
    pub to: Time,
}

/// One expectation.
#[derive(Debug, Clone, PartialEq)]
pub struct Expectation {
    /// What is measured.
    pub metric: Metric,
    /// What it is held against.
    pub limit: Limit,
    /// The paper's value.
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    pub requirement: Option<String>,
    /// Confidence at which a verdict over trials is made.
    pub confidence: f64,
    /// What the trials come to.
    pub over: Over,
    /// Half width of the band around the setpoint, percent.
    pub band_percent: f64,
    /// From when on to look.
    pub from: Option<Time>,
    /// The window of a mean; of a shutdown, from when to when it has to happen and last.
    pub window: Window,
    /// Name of the column to look at.
    pub signal: &'static str,
}

/// Columns that an expectation may look at: those that are held against the setpoint.
pub const SIGNALS: [&str; 5] = ["amplitude_um", "wd_um", "wq_um", "sensed_wd_um", "sensed_wq_um"];

impl Expectation {
    /// The two edges of the band around `setpoint`, both still inside.
    pub fn band(&self, setpoint: f64) -> (f64, f64) {
        let half = setpoint.abs() * self.band_percent / 100.0;
        (setpoint - half, setpoint + half)
    }
}
