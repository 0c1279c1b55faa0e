//! Decides whether a value conforms to its limits under a decision rule (ILAC-G8:09/2019, 4.2).

use crate::combine::CombinedUncertainty;
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

/// One-sided, of a normal error at k = 2. It is smaller than 2.5 %, because Welch-Satterthwaite is
/// an approximation.
pub const GUARD_PROBABILITY: f64 = 0.022_75;

/// Result of a decision rule for a value that meets its limits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Conformity {
    Accepted,
    /// The value is closer to the limit than the guard band.
    WithinGuardBand {
        guard_band: f64,
    },
    /// The expanded uncertainty is `share_percent` of the tolerance, more than the allowed
    /// `largest_percent`.
    TooUncertain {
        share_percent: f64,
        largest_percent: f64,
    },
}

/// `value` must be in `range`, the smallest and the largest conforming value. For
/// [`DecisionRule::SharedRisk`] the expanded uncertainty may be `largest_percent` of `tolerance`,
/// the scale of the limit.
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
            // False for NaN.
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
