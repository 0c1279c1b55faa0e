//! Decides whether a value conforms to its limits under a decision rule (ILAC-G8:09/2019, 4.2).

use crate::combine::CombinedUncertainty;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Decision rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DecisionRule {
    /// The value decides; the uncertainty is stated only.
    Simple,
    /// The value must keep a guard band to the limit: a false acceptance has a probability below 2.5 %.
    Guarded,
    /// The value decides if the expanded uncertainty is small enough; both parties share the risk.
    SharedRisk,
}

impl DecisionRule {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Simple => "simple",
            Self::Guarded => "guarded",
            Self::SharedRisk => "shared-risk",
        }
    }
}

impl fmt::Display for DecisionRule {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// One-sided, at the limit: that of k = 2 for a normal error, so that a value at the limit is
/// accepted in less than 2.5 % of cases although Welch-Satterthwaite is an approximation.
pub const GUARD_PROBABILITY: f64 = 0.022_75;

/// Result of a decision rule for a value that meets its limits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Conformity {
    Accepted,
    /// The value keeps less than the guard band.
    WithinGuardBand {
        guard_band: f64,
    },
    /// The expanded uncertainty exceeds this share of the tolerance, in percent.
    TooUncertain {
        share_percent: f64,
        largest_percent: f64,
    },
}

/// `range`: smallest and largest conforming value, `tolerance`: the scale of the limit,
/// `largest_percent`: of the tolerance, for [`DecisionRule::SharedRisk`]. Only for values in range.
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
            // NaN is not inside.
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
