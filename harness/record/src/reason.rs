//! Names why an expectation or a trial did not pass.

use crate::bounds::Bounds;
use crate::exclusion::Exclusion;
use crate::excuse::Excuse;
use crate::missing_value::{MissingValue, UndefinedValue};
use crate::violation::Violation;
use platebench_scenario::Limit;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use thiserror::Error;

/// When and how a trial diverged.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Divergence {
    /// When it began, s.
    pub at_s: f64,
    /// True if a NaN or infinite drive command began it.
    pub is_non_finite: bool,
}

impl fmt::Display for Divergence {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cause = if self.is_non_finite { ": the drive command was NaN or infinite" } else { "" };
        write!(formatter, "diverged at t = {:.1} ms{cause}", self.at_s * 1e3)
    }
}

/// Why a trial does not count or did not end well.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Error)]
#[serde(rename_all = "snake_case")]
pub enum TrialReason {
    /// It does not count.
    #[error(transparent)]
    Excluded(Exclusion),
    /// The controller was lost; the rig's words.
    #[error("{0}")]
    Ended(String),
    /// The loop does not converge.
    #[error("{0}")]
    Diverged(Divergence),
    /// The controller breached the protocol.
    #[error("{0}")]
    Violation(Violation),
}

/// What a single trial shows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Error)]
#[serde(rename_all = "snake_case")]
pub enum TrialFinding {
    /// No value: the controller's failure.
    #[error(transparent)]
    Missing(MissingValue),
    /// The metric does not apply.
    #[error(transparent)]
    Undefined(UndefinedValue),
    /// The value breaks the limit; `None` if it is infinite.
    #[error("{}, expected {limit}", format_value(*value))]
    Outside {
        /// The value.
        value: Option<f64>,
        /// The limit.
        limit: Limit,
    },
    /// The value is known to lie in an interval, which breaks the limit.
    #[error("{bounds}, expected {limit}")]
    IntervalOutside {
        /// The interval.
        bounds: Bounds,
        /// The limit.
        limit: Limit,
    },
    /// Samples are too coarse to decide.
    #[error("{bounds} by its samples, which does not decide {limit}")]
    CoarseSamples {
        /// Interval of the value.
        bounds: Bounds,
        /// The limit.
        limit: Limit,
    },
    /// The error of the simulation is too large to decide.
    #[error("{bounds} with the bench's own error, which does not decide {limit}")]
    SimulationError {
        /// Interval of the value.
        bounds: Bounds,
        /// The limit.
        limit: Limit,
    },
}

/// Trials that diverged.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DivergedTrials {
    /// Number of the first.
    pub first: u32,
    /// How that one diverged.
    pub divergence: Divergence,
    /// Number of further ones.
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

/// Why bounds are wide.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Error)]
#[serde(rename_all = "snake_case")]
pub enum WideBounds {
    /// Order statistics need more trials.
    #[error("a bound of the {} quantile needs {needed} trials, {trials} were run", percent(*share))]
    TooFewForQuantile {
        /// Which quantile.
        share: f64,
        /// Trials that it needs.
        needed: u32,
        /// Trials that count.
        trials: usize,
    },
    /// Bounds come from resampling.
    #[error("the trials are not normally distributed")]
    NotNormal,
}

/// Why an expectation did not pass.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// One trial decided.
    Trial {
        /// Its number.
        trial: u32,
        /// Whether it diverged, if it failed.
        divergence: Option<Divergence>,
        /// What it shows.
        finding: TrialFinding,
        /// How the controller was lost.
        ended: Option<String>,
    },
    /// The controller breached the protocol.
    Violation {
        /// The first trial with a breach.
        trial: u32,
        /// Its first kind of breach.
        violation: Violation,
    },
    /// A trial does not count.
    Excluded {
        /// Its number.
        trial: u32,
        /// Why.
        exclusion: Exclusion,
    },
    /// The failure is not the controller's.
    Excused(Excuse),
    /// Trials are missing.
    NotPlayed {
        /// Trials that were played.
        played: usize,
        /// Trials that were planned.
        planned: usize,
    },
    /// Too few trials count.
    TooFewTrials {
        /// Trials that count.
        counted: usize,
        /// Trials that are needed.
        needed: usize,
    },
    /// The statistic over trials breaks the limit.
    Outside {
        /// The statistic; `None` if it is infinite.
        value: Option<f64>,
        /// Its interval.
        bounds: Bounds,
        /// The limit.
        limit: Limit,
        /// Trials that diverged.
        diverged: Option<DivergedTrials>,
    },
    /// The interval over trials contains the limit.
    Undecided {
        /// Trials that count.
        trials: usize,
        /// Interval of the statistic.
        bounds: Bounds,
        /// The limit.
        limit: Limit,
        /// Why the interval is wide.
        cause: Option<WideBounds>,
    },
    /// All trials gave the same value, so they show no repeatability.
    NoVariation {
        /// Trials that count.
        trials: usize,
    },
    /// The deviation over trials differs from the expected one.
    Disagrees {
        /// The deviation.
        value: f64,
        /// Its interval.
        bounds: Bounds,
        /// The expected deviation.
        expected: f64,
        /// Trials that diverged.
        diverged: Option<DivergedTrials>,
    },
    /// The interval is too wide to tell the expected deviation from its half or double.
    Indistinct {
        /// Trials that count.
        trials: usize,
        /// The deviation.
        value: f64,
        /// Its interval.
        bounds: Bounds,
        /// The expected deviation.
        expected: f64,
    },
}

impl fmt::Display for Reason {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let suffix = |diverged: &Option<DivergedTrials>| diverged.map_or_else(String::new, |all| format!(": {all}"));
        match self {
            Self::Trial { trial, divergence, finding, ended } => {
                write!(formatter, "trial {trial}: ")?;
                if let Some(divergence) = divergence {
                    write!(formatter, "{divergence}: ")?;
                }
                write!(formatter, "{finding}")?;
                ended.iter().try_for_each(|ended| write!(formatter, ": {ended}"))
            }
            Self::Violation { trial, violation } => write!(formatter, "trial {trial}: {violation}"),
            Self::Excluded { trial, exclusion } => write!(formatter, "trial {trial}: {exclusion}"),
            Self::Excused(excuse) => write!(formatter, "{excuse}"),
            Self::NotPlayed { played, planned } => write!(formatter, "{played} of {planned} trials were played"),
            Self::TooFewTrials { counted: 0, .. } => formatter.write_str("no trial counts"),
            Self::TooFewTrials { counted, needed } => {
                write!(formatter, "{counted} of the trials count, expected at least {needed}")
            }
            Self::Outside { value, bounds, limit, diverged } => {
                write!(formatter, "{}, {bounds}, expected {limit}{}", format_value(*value), suffix(diverged))
            }
            Self::Undecided { trials, bounds, limit, cause } => {
                let cause = cause.map_or_else(String::new, |cause| format!(": {cause}"));
                write!(formatter, "by {trials} trials it is {bounds}, which does not decide {limit}{cause}")
            }
            Self::NoVariation { trials } => {
                write!(formatter, "all {trials} trials gave the same value, which shows no repeatability")
            }
            Self::Disagrees { value, bounds, expected, diverged } => {
                write!(formatter, "{value:.4}, {bounds}: does not agree with {expected}{}", suffix(diverged))
            }
            Self::Indistinct { trials, value, bounds, expected } => write!(
                formatter,
                "by {trials} trials it is {value:.4}, {bounds}, which does not distinguish {expected} from its half \
                 or double"
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

/// Writes a reason twice: `reason` is a sentence for people, `reason_code` is what readers parse.
pub(crate) mod file_keys {
    use super::{Deserialize, Deserializer, Serialize, Serializer, fmt};

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
