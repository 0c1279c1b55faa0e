//! Holds the verdict of one expectation before it is recorded.

use platebench_model::record::{Cause, Evidence, Reason, Statistic, Verdict};

#[derive(Debug, Clone)]
pub(super) struct Outcome {
    pub(super) verdict: Verdict,
    pub(super) cause: Option<Cause>,
    pub(super) reason: Option<Reason>,
    pub(super) value: Option<f64>,
    pub(super) statistic: Statistic,
    pub(super) interval: Option<[f64; 2]>,
    pub(super) confidence: Option<f64>,
    pub(super) evidence: Evidence,
}

impl Outcome {
    pub(super) fn pass(statistic: Statistic) -> Self {
        Self {
            verdict: Verdict::Pass,
            cause: None,
            reason: None,
            value: None,
            statistic,
            interval: None,
            confidence: None,
            evidence: Evidence::default(),
        }
    }

    pub(super) fn fail(self, reason: Reason) -> Self {
        Self { verdict: Verdict::Fail, cause: None, reason: Some(reason), ..self }
    }

    pub(super) fn inconclusive(self, cause: Cause, reason: Reason) -> Self {
        Self { verdict: Verdict::Inconclusive, cause: Some(cause), reason: Some(reason), ..self }
    }

    pub(super) fn severity(&self) -> u8 {
        match self.verdict {
            Verdict::Fail => 2,
            Verdict::Inconclusive => 1,
            Verdict::Pass => 0,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Containment {
    Inside,
    Outside,
    Straddles,
}

pub(super) fn containment((lowest, highest): (f64, f64), [low, high]: [f64; 2]) -> Containment {
    if lowest <= low && high <= highest {
        Containment::Inside
    } else if high < lowest || highest < low {
        Containment::Outside
    } else {
        Containment::Straddles
    }
}

/// Distance of the worst value from the permitted range; negative if all values are inside.
pub(super) fn exceedance((lowest, highest): (f64, f64), [low, high]: [f64; 2]) -> f64 {
    (lowest - low).max(high - highest)
}
