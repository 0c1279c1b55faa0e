//! Records the result of an expectation with its reasons, as types and as text (`Display`).

use crate::metrics::{MissingValue, SignalPoint, UndefinedValue};
use crate::record::reason;
use crate::record::verdict::Exclusion;
use crate::record::verdict::Excuse;
use crate::record::verdict::Violation;
use crate::record::verdict::{Cause, Verdict};
use crate::scenario::{Expectation, Limit, Metric};
use platebench_plate::{Time, is_default};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use thiserror::Error;

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Divergence {
    pub at_s: f64,
    /// True if a NaN or infinite drive command caused the divergence.
    pub is_non_finite: bool,
}

impl fmt::Display for Divergence {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cause = if self.is_non_finite { ": the drive command was NaN or infinite" } else { "" };
        write!(formatter, "diverged at t = {:.1} ms{cause}", self.at_s * 1e3)
    }
}

/// What a trace shows of a likely cause. It decides no verdict.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum LoopSymptom {
    #[error("the drive stayed at 0 V although the setpoint was above 0: sign of the amplitude loop?")]
    NoDrive,
    #[error("the frequency ended at its limit, away from the resonance: sign of the frequency loop?")]
    FrequencyAtLimit,
    #[error(
        "the drive command was NaN or infinite: layout of the sample or the command (offsets, byte order), or a \
         division by 0?"
    )]
    NotFinite,
    #[error(
        "a single drive command differs much from those before and after it: layout of the command, or a buffer that \
         changes while it is sent?"
    )]
    DriveSpike,
    #[error("the command's frequency is far from the start: order, offset or unit (mHz) of the fields of the command?")]
    FarFrequency,
    #[error("Wd passed the setpoint after, or while, the drive was at its limit: anti-windup of the loop?")]
    WindUp,
    #[error("the drive ended at its limit with Wd above the setpoint: sign, unit or order of Wd and Wq in the sample?")]
    LimitAboveSetpoint,
    /// Gains of the amplitude loop relative to the design of `docs/wire-protocol.md`.
    #[error(
        "the drive follows a PI law with {kp:.3} times Kp and {ki:.3} times Ki of the design in \
         docs/wire-protocol.md: gains, or the unit of the plate's gain or of the period?"
    )]
    FarGains { kp: f64, ki: f64 },
    #[error(
        "the drive switches between 0 V and its limit: gains too large, such as a period in ms or µs instead of s, or \
         a gain of the plate in another unit?"
    )]
    SwitchingDrive,
    #[error(
        "the amplitude stays off the setpoint and the drive does not move: no integral, or a period in another unit?"
    )]
    UnmovedDrive,
    #[error(
        "the image is marked as hard float, but no instruction of the FPU ran: a compiler without an FPU passes floats \
         in core registers (zig cc: -mcpu=cortex_m4+vfp4d16sp)?"
    )]
    UnusedFpu,
}

impl LoopSymptom {
    /// True if a loop that passes may show it, so that it explains failures only.
    pub const fn explains_failures_only(self) -> bool {
        !matches!(self, Self::NoDrive | Self::FrequencyAtLimit)
    }
}

/// Why a trial does not count or did not end well.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum TrialReason {
    #[error(transparent)]
    Excluded(Exclusion),
    /// The rig's message about the loss of the controller.
    #[error("{0}")]
    Ended(String),
    #[error("{0}")]
    Diverged(Divergence),
    #[error("{0}")]
    Violation(Violation),
}

/// Why one trial did not meet an expectation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum TrialFinding {
    #[error(transparent)]
    Missing(MissingValue),
    #[error(transparent)]
    Undefined(UndefinedValue),
    #[error("{}, expected {limit}", format_value(*value))]
    Outside {
        /// `null` if it is infinite.
        value: Option<f64>,
        limit: Limit,
    },
    #[error("{bounds}, expected {limit}")]
    IntervalOutside { bounds: Bounds, limit: Limit },
    #[error(
        "{bounds}, because the signal is known at control instants only; this does not decide whether it is {limit}"
    )]
    CoarseSamples { bounds: Bounds, limit: Limit },
    #[error("{bounds} including the error of the simulation; this does not decide whether it is {limit}")]
    SimulationError { bounds: Bounds, limit: Limit },
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DivergedTrials {
    pub first: u32,
    pub divergence: Divergence,
    pub further: usize,
}

impl fmt::Display for DivergedTrials {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "trial {} {}", self.first, self.divergence)?;
        match self.further {
            0 => Ok(()),
            further => write!(formatter, ", and {further} more trials diverged"),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct StoppedTrial {
    pub trial: u32,
    /// The controller's first reason.
    pub why: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum WideBoundsCause {
    #[error("a bound of the {} quantile needs {needed} trials, {trials} were run", percent(*share))]
    TooFewForQuantile { share: f64, needed: u32, trials: usize },
    #[error("the trials are not normally distributed")]
    NotNormal,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    Trial {
        trial: u32,
        /// Present if the trial failed because it diverged.
        divergence: Option<Divergence>,
        finding: TrialFinding,
        /// The rig's message about the loss of the controller.
        ended: Option<String>,
        /// The controller's first reason for a stop.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        stopped: Option<String>,
    },
    Violation {
        trial: u32,
        violation: Violation,
    },
    Excluded {
        trial: u32,
        exclusion: Exclusion,
    },
    Excused(Excuse),
    NotPlayed {
        played: usize,
        planned: usize,
    },
    /// The time limit of the scenario ended its trials.
    TimeLimit {
        limit_s: f64,
        played: usize,
        planned: usize,
    },
    TooFewTrials {
        counted: usize,
        needed: usize,
    },
    /// The statistic over trials breaks the limit. `value` is `null` if it is infinite.
    Outside {
        value: Option<f64>,
        bounds: Bounds,
        limit: Limit,
        diverged: Option<DivergedTrials>,
        /// The first trial in which the controller stopped.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        stopped: Option<StoppedTrial>,
    },
    /// The interval of the statistic over trials contains the limit.
    Undecided {
        trials: usize,
        bounds: Bounds,
        limit: Limit,
        cause: Option<WideBoundsCause>,
    },
    NoVariation {
        trials: usize,
    },
    Disagrees {
        value: f64,
        bounds: Bounds,
        expected: f64,
        diverged: Option<DivergedTrials>,
    },
    /// The interval is too wide to exclude half and double of `expected`.
    Indistinct {
        trials: usize,
        value: f64,
        bounds: Bounds,
        expected: f64,
    },
}

impl fmt::Display for Reason {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let suffix = |diverged: &Option<DivergedTrials>| diverged.map_or_else(String::new, |all| format!(": {all}"));
        match self {
            Self::Trial { trial, divergence, finding, ended, stopped } => {
                write!(formatter, "trial {trial}: ")?;
                match (divergence, finding) {
                    (Some(divergence), TrialFinding::Missing(MissingValue::NonFiniteDrive))
                        if divergence.is_non_finite =>
                    {
                        write!(formatter, "{divergence}")?;
                    }
                    (Some(divergence), finding) => write!(formatter, "{divergence}: {finding}")?,
                    (None, finding) => write!(formatter, "{finding}")?,
                }
                stopped.iter().try_for_each(|why| write!(formatter, "; the controller stopped: {why}"))?;
                ended.iter().try_for_each(|ended| write!(formatter, ": {ended}"))
            }
            Self::Violation { trial, violation } => write!(formatter, "trial {trial}: {violation}"),
            Self::Excluded { trial, exclusion } => write!(formatter, "trial {trial}: {exclusion}"),
            Self::Excused(excuse) => write!(formatter, "{excuse}"),
            Self::NotPlayed { played, planned } => write!(formatter, "{played} of {planned} trials were played"),
            Self::TimeLimit { limit_s, played, planned } => {
                write!(formatter, "time limit of {limit_s} s reached: {played} of {planned} trials were played")
            }
            Self::TooFewTrials { counted: 0, .. } => formatter.write_str("no trial counts"),
            Self::TooFewTrials { counted, needed } => {
                write!(
                    formatter,
                    "{counted} of the trials count, expected at least {needed}: raise [trials] count or --trials"
                )
            }
            Self::Outside { value, bounds, limit, diverged, stopped } => {
                write!(formatter, "{}, {bounds}, expected {limit}{}", format_value(*value), suffix(diverged))?;
                stopped.iter().try_for_each(|StoppedTrial { trial, why }| {
                    write!(formatter, "; in trial {trial} the controller stopped: {why}")
                })
            }
            Self::Undecided { cause: Some(cause @ WideBoundsCause::TooFewForQuantile { .. }), .. } => {
                write!(formatter, "too few trials to decide: {cause}")
            }
            Self::Undecided { trials, bounds, limit, cause } => {
                let cause = cause.map_or_else(String::new, |cause| format!(": {cause}"));
                write!(
                    formatter,
                    "{trials} trials show a value {bounds}; this does not decide whether it is {limit}{cause}"
                )
            }
            Self::NoVariation { trials } => {
                write!(formatter, "all {trials} trials gave the same value, which shows no repeatability")
            }
            Self::Disagrees { value, bounds, expected, diverged } => {
                write!(formatter, "{value:.4}, {bounds}, which excludes the expected {expected}{}", suffix(diverged))
            }
            Self::Indistinct { trials, value, bounds, expected } => write!(
                formatter,
                "{trials} trials show {value:.4}, {bounds}, which does not exclude half or double of the expected \
                 {expected}"
            ),
        }
    }
}

fn format_value(value: Option<f64>) -> String {
    value.map_or_else(|| "infinite".to_owned(), |value| format!("{value:.4}"))
}

/// A share in percent with two decimals, or with an exponent below 0.01 %.
pub fn percent(share: f64) -> String {
    let percent = share * 100.0;
    if percent > 0.0 && percent < 0.01 { format!("{percent:.1e} %") } else { format!("{percent:.2} %") }
}

/// Writes a reason twice: `reason` is a sentence for people, `reason_code` is for programs.
pub(crate) mod file_keys {
    use super::{Deserialize, Deserializer, JsonSchema, Serialize, Serializer, fmt};

    #[derive(Serialize)]
    struct Written<'a, R> {
        reason: Option<String>,
        #[serde(skip_serializing_if = "Option::is_none")]
        reason_code: &'a Option<R>,
    }

    #[derive(Deserialize)]
    struct Read<R> {
        reason_code: Option<R>,
    }

    #[derive(JsonSchema)]
    #[allow(dead_code, reason = "only its schema is used")]
    pub(crate) struct Keys<R> {
        /// A sentence for people.
        reason: Option<String>,
        /// For programs.
        #[schemars(skip_serializing_if = "Option::is_none")]
        reason_code: Option<R>,
    }

    #[allow(clippy::ref_option, reason = "serde fixes the signature")]
    pub(crate) fn serialize<R, S>(reason: &Option<R>, serializer: S) -> Result<S::Ok, S::Error>
    where
        R: Serialize + fmt::Display,
        S: Serializer,
    {
        Written { reason: reason.as_ref().map(ToString::to_string), reason_code: reason }.serialize(serializer)
    }

    pub(crate) fn deserialize<'de, R, D>(deserializer: D) -> Result<Option<R>, D::Error>
    where
        R: Deserialize<'de>,
        D: Deserializer<'de>,
    {
        Ok(Read::deserialize(deserializer)?.reason_code)
    }
}

/// An infinite end is `null`, because JSON has no infinity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Bounds {
    pub low: Option<f64>,
    pub high: Option<f64>,
}

impl From<[f64; 2]> for Bounds {
    fn from([low, high]: [f64; 2]) -> Self {
        let finite = |end: f64| end.is_finite().then_some(end);
        Self { low: finite(low), high: finite(high) }
    }
}

impl fmt::Display for Bounds {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.low, self.high) {
            (Some(low), Some(high)) => write!(formatter, "between {low:.4} and {high:.4}"),
            (Some(low), None) => write!(formatter, "above {low:.4}, without an upper bound"),
            (None, Some(high)) => write!(formatter, "below {high:.4}, without a lower bound"),
            (None, None) => formatter.write_str("without bounds"),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExpectationRecord {
    /// Unique name of the expectation in the scenario. It does not depend on the limit.
    pub name: String,
    pub metric: Metric,
    pub verdict: Verdict,
    /// Value of `statistic`; `null` if the deciding trial has no number.
    pub value: Option<f64>,
    pub statistic: Statistic,
    pub limit: Limit,
    /// Distance of `value` to the limit, divided by the limit's scale, see [`Limit::margin`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<f64>,
    /// Standard uncertainty that arithmetic, rows, messages and sampling of the bench add to `value`,
    /// in its unit. Noise and converters belong to the scenario and are no part of it. Absent on a
    /// real plate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bench_error: Option<f64>,
    /// Smallest and largest value over trials if `statistic` is `worst`, otherwise the bounds at
    /// `confidence`.
    pub interval: Option<[f64; 2]>,
    /// Confidence of each bound or of the failure rate; `null` if nothing is random.
    pub confidence: Option<f64>,
    pub cause: Option<Cause>,
    #[serde(flatten, with = "reason::file_keys")]
    #[schemars(with = "reason::file_keys::Keys<Reason>")]
    pub reason: Option<Reason>,
    pub paper: Option<f64>,
    pub requirement: Option<String>,
    /// Start and end of each judged window, ms. The worst window decides.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub windows_ms: Vec<[f64; 2]>,
    /// Absent if no trial has a measurement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worst: Option<WorstInstant>,
    #[serde(flatten)]
    pub definition: MetricDefinition,
    #[serde(default, skip_serializing_if = "is_default")]
    pub evidence: Evidence,
}

/// Trial, window and instants that decided the value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct WorstInstant {
    pub trial: u32,
    /// Start and end, ms.
    pub window_ms: [f64; 2],
    /// Worst values of the signal that the metric evaluates. Two for a ripple; absent if no instant
    /// decides, as for a count.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<SignalPoint>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Statistic {
    Worst,
    Mean,
    Quantile,
    Deviation,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MetricDefinition {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_percent: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
}

impl MetricDefinition {
    pub fn of(expectation: &Expectation) -> Self {
        let metric = expectation.metric;
        Self {
            from_ms: expectation.from.filter(|_| metric.has_from_ms()).map(Time::ms),
            band_percent: metric.has_band().then_some(expectation.band_percent),
            signal: metric.has_signal().then(|| expectation.signal.to_owned()),
            text: metric.has_text().then(|| expectation.text.clone()),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum EvidenceMethod {
    /// Student's t, for the mean of normal data.
    T,
    /// Chi-square, for the deviation of normal data.
    ChiSquare,
    /// The outer ends of BCa and of the studentised bootstrap, for data that are not normal.
    Bootstrap,
    /// Ranks of the sample, for quantiles.
    #[serde(rename = "order statistics")]
    OrderStatistics,
    /// Exact binomial bounds, for the share of trials that fail.
    ClopperPearson,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Evidence {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method: Option<EvidenceMethod>,
    /// Bounds of the share of trials that break the limit, at the expectation's confidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure_rate: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantile: Option<f64>,
    /// Probability of detecting half or double of the expected deviation, for normal data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<f64>,
    /// Number of the look (evaluation of the trials so far) that decided, and number of planned
    /// looks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look: Option<[u32; 2]>,
    /// The evidence as a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub says: Option<String>,
    /// Sensor that measured, if the true motion of the plate is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observed: Option<String>,
}
