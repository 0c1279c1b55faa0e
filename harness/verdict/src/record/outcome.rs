//! How something ended, and whose doing it is where it did not.

use serde::{Deserialize, Serialize};
use std::fmt;

/// How something ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Demonstrated.
    Pass,
    /// Refuted.
    Fail,
    /// Neither; the cause is beside it.
    Inconclusive,
}

impl Verdict {
    /// The verdict over several: one failure fails all, and one doubt remains a doubt. Nothing at all is a doubt.
    pub fn over(verdicts: impl IntoIterator<Item = Self>) -> Self {
        verdicts
            .into_iter()
            .reduce(|a, b| match (a, b) {
                (Self::Fail, _) | (_, Self::Fail) => Self::Fail,
                (Self::Pass, Self::Pass) => Self::Pass,
                _ => Self::Inconclusive,
            })
            .unwrap_or(Self::Inconclusive)
    }

    /// The verdict in a word.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pass => "pass",
            Self::Fail => "fail",
            Self::Inconclusive => "inconclusive",
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.pad(self.name())
    }
}

/// Whose doing it is that there is no verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Cause {
    /// The link to the controller, or a delay that it adds.
    Rig,
    /// The bench itself was too late or lost a row.
    Bench,
    /// No controller could have met the demand.
    Infeasible,
    /// Too few trials for the stated confidence.
    Evidence,
}

impl fmt::Display for Cause {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Rig => "rig",
            Self::Bench => "bench",
            Self::Infeasible => "infeasible",
            Self::Evidence => "evidence",
        })
    }
}
