//! Names why an expectation or a trial did not pass.

use crate::metrics::{MissingValue, UndefinedValue};
use crate::record::bounds::Bounds;
use crate::record::exclusion::Exclusion;
use crate::record::excuse::Excuse;
use crate::record::violation::Violation;
use crate::scenario::Limit;
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
