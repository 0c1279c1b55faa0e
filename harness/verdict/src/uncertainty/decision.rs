//! Decides whether a value conforms to its limits under a decision rule (ILAC-G8:09/2019, 4.2).

use crate::uncertainty::combine::CombinedUncertainty;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Decision rule.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, strum::IntoStaticStr, strum::Display,
)]
#[strum(const_into_str, serialize_all = "kebab-case")]
#[serde(rename_all = "kebab-case")]
pub enum DecisionRule {
    /// The value must meet the limit. The record states the uncertainty, which changes no verdict.
    Simple,
    /// The value must meet the limit with a guard band. A false acceptance then has a probability
    /// below 2.5 %.
    Guarded,
    /// The value must meet the limit, and the expanded uncertainty must be small enough. Both
    /// parties share the risk.
    SharedRisk,
}

impl DecisionRule {
    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

/// Probability that a normal error exceeds 2 standard deviations on one side. It is below 2.5 % as
/// a reserve, because the Welch-Satterthwaite equation is an approximation.
pub const GUARD_PROBABILITY: f64 = 0.022_75;

/// Result of a decision rule for a value that meets its limits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Conformity {
    Accepted,
    /// The distance from the value to the limit is smaller than the guard band.
    WithinGuardBand {
        guard_band: f64,
    },
    /// The expanded uncertainty is `share_percent` of the tolerance; allowed is `largest_percent`.
    TooUncertain {
        share_percent: f64,
        largest_percent: f64,
    },
}

/// `range` contains the smallest and the largest conforming value, and `value` must be within it.
/// For [`DecisionRule::SharedRisk`] the expanded uncertainty must be at most `largest_percent` of
/// `tolerance`, the scale of the limit.
pub fn decide(
    rule: DecisionRule,
    value: f64,
    uncertainty: &CombinedUncertainty,
    range: (f64, f64),
    tolerance: f64,
    largest_percent: f64,
) -> Conformity {
    match rule {
        DecisionRule::Simple => Conformity::Accepted,
        DecisionRule::Guarded => {
            let guard_band = uncertainty.one_sided_reach(GUARD_PROBABILITY);
            // The comparison is false for NaN, so NaN is not accepted.
            let is_inside = range.0 + guard_band <= value && value <= range.1 - guard_band;
            if is_inside { Conformity::Accepted } else { Conformity::WithinGuardBand { guard_band } }
        }
        DecisionRule::SharedRisk => {
            let share_percent = uncertainty.expanded / tolerance.abs() * 100.0;
            if share_percent <= largest_percent {
                Conformity::Accepted
            } else {
                Conformity::TooUncertain { share_percent, largest_percent }
            }
        }
    }
}

#[cfg(test)]
mod tests;
