//! Records the share of the control period that the control steps take on the emulated chip.

use crate::record::violation::{Violation, ViolationKind};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Limit of a scenario without an expectation of its own, percent of the control period.
const LIMIT_PERCENT: f64 = 100.0;
/// Above this share the bench warns, because a real chip needs more than one cycle per instruction.
const TIGHT_PERCENT: f64 = 80.0;

/// Control steps of a trial, at one instruction per cycle.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StepTime {
    /// Longest step, percent of the control period.
    pub longest_percent: f64,
    /// Number of steps that took longer than the period.
    #[serde(default)]
    pub overlong: u64,
    /// Start of the first step that took longer than the period; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_overlong_s: Option<f64>,
}

impl StepTime {
    pub fn record(&mut self, percent: f64, at_s: f64) {
        let overlong = percent > LIMIT_PERCENT;
        self.include(&Self {
            longest_percent: percent,
            overlong: overlong.into(),
            first_overlong_s: overlong.then_some(at_s),
        });
    }

    /// Adds the steps of a later scene.
    pub fn include(&mut self, later: &Self) {
        self.longest_percent = self.longest_percent.max(later.longest_percent);
        self.overlong += later.overlong;
        self.first_overlong_s = self.first_overlong_s.or(later.first_overlong_s);
    }

    /// Present if a step took longer than the period.
    pub fn violation(&self) -> Option<Violation> {
        Some(Violation {
            kind: ViolationKind::StepTime,
            at_s: self.first_overlong_s?,
            count: self.overlong,
            worst: Some(self.longest_percent),
            limit: Some(LIMIT_PERCENT),
        })
    }

    /// True if the longest step fits into the period, but a real chip may need longer.
    pub fn is_tight(&self) -> bool {
        self.longest_percent > TIGHT_PERCENT && self.longest_percent <= LIMIT_PERCENT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_step_longer_than_its_period_is_a_violation() {
        let mut steps = StepTime::default();
        steps.record(80.0, 0.0);
        assert!(!steps.is_tight() && steps.violation().is_none(), "{steps:?}");
        steps.record(100.0, 1e-3);
        assert!(steps.is_tight() && steps.violation().is_none(), "{steps:?}");
        steps.record(111.25, 2e-3);
        steps.record(100.5, 3e-3);
        assert!(!steps.is_tight(), "{steps:?}");
        let violation = steps.violation().unwrap();
        assert_eq!((violation.worst, violation.limit, violation.count), (Some(111.25), Some(100.0), 2));
        assert_eq!(
            violation.to_string(),
            "the longest control step takes 111.2 % of the control period on the emulated chip, limit 100 %, first at \
             2.0 ms, 2 in total"
        );
    }
}
