//! What decided, before it is written down.

use crate::record::{Cause, Evidence, Verdict};
use platebench_scenario::Limit;
use serde_json::{Map, Value, json};

/// What came of an expectation.
pub(super) struct Finding {
    pub(super) verdict: Verdict,
    pub(super) cause: Option<Cause>,
    pub(super) reason: Option<String>,
    pub(super) value: Option<f64>,
    pub(super) statistic: &'static str,
    pub(super) interval: Option<[f64; 2]>,
    pub(super) confidence: Option<f64>,
    pub(super) evidence: Evidence,
}

impl Finding {
    /// Nothing is wrong, so far.
    pub(super) fn pass(statistic: &'static str) -> Self {
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

    pub(super) fn fail(self, reason: String) -> Self {
        Self { verdict: Verdict::Fail, cause: None, reason: Some(reason), ..self }
    }

    pub(super) fn doubt(self, cause: Cause, reason: String) -> Self {
        Self { verdict: Verdict::Inconclusive, cause: Some(cause), reason: Some(reason), ..self }
    }

    /// A failure weighs more than a doubt, and a doubt more than a pass.
    pub(super) fn gravity(&self) -> u8 {
        match self.verdict {
            Verdict::Fail => 2,
            Verdict::Inconclusive => 1,
            Verdict::Pass => 0,
        }
    }
}

/// How a stretch of values lies to a limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Held {
    /// All of it keeps the limit.
    Whole,
    /// None of it does.
    None,
    /// The limit lies inside.
    Part,
}

/// How the values from `low` to `high` lie to `limit`.
pub(super) fn held(limit: Limit, [low, high]: [f64; 2]) -> Held {
    let (lowest, highest) = limit.range();
    if lowest <= low && high <= highest {
        Held::Whole
    } else if high < lowest || highest < low {
        Held::None
    } else {
        Held::Part
    }
}

/// How far beyond the limit the worst of the values from `low` to `high` lies; negative where it is good.
pub(super) fn badness(limit: Limit, [low, high]: [f64; 2]) -> f64 {
    let (lowest, highest) = limit.range();
    (lowest - low).max(high - highest)
}

pub(super) fn limit_record(limit: Limit) -> Map<String, Value> {
    let (name, value) = match limit {
        Limit::AtMost(value) => ("at_most", json!(value)),
        Limit::AtLeast(value) => ("at_least", json!(value)),
        Limit::Within(low, high) => ("within", json!([low, high])),
        Limit::About { value, .. } => ("about", json!(value)),
    };
    Map::from_iter([(name.to_owned(), value)])
}

/// A share in percent, to two decimals or as many as it takes to see it.
pub(super) fn percent(share: f64) -> String {
    let percent = share * 100.0;
    if percent > 0.0 && percent < 0.01 { format!("{percent:.1e} %") } else { format!("{percent:.2} %") }
}

/// A bound as it is read: none where it is infinite.
pub(super) fn between([low, high]: [f64; 2]) -> String {
    match (low.is_finite(), high.is_finite()) {
        (true, true) => format!("between {low:.4} and {high:.4}"),
        (true, false) => format!("above {low:.4} without a bound"),
        (false, true) => format!("below {high:.4} without a bound"),
        (false, false) => "without bounds".to_owned(),
    }
}
