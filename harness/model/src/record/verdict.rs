//! Defines verdicts and the causes of inconclusive ones.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema, strum::IntoStaticStr, strum::Display,
)]
#[strum(const_into_str, serialize_all = "lowercase")]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    Pass,
    Fail,
    Inconclusive,
}

impl Verdict {
    /// Fails if any fails, passes if all pass, and is otherwise, or without any, inconclusive.
    pub fn combine(verdicts: impl IntoIterator<Item = Self>) -> Self {
        verdicts
            .into_iter()
            .reduce(|a, b| match (a, b) {
                (Self::Fail, _) | (_, Self::Fail) => Self::Fail,
                (Self::Pass, Self::Pass) => Self::Pass,
                _ => Self::Inconclusive,
            })
            .unwrap_or(Self::Inconclusive)
    }

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

/// Why a verdict is inconclusive.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema, strum::Display,
)]
#[strum(serialize_all = "lowercase")]
#[serde(rename_all = "lowercase")]
pub enum Cause {
    /// The link to the controller, or its delay.
    Rig,
    /// The bench itself was too late or lost a row.
    Bench,
    /// No controller can meet the demand.
    Infeasible,
    /// Too few trials for the confidence, or missing traces.
    Evidence,
}
