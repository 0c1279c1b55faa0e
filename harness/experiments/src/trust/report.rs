//! Defines the report of `platebench trust` (`trust.json`).

use platebench_model::record::Verdict;
use platebench_verdict::statistics::proportion::clopper_pearson;
use serde::Serialize;

/// Confidence of each one-sided bound.
pub const CONFIDENCE: f64 = 0.95;

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrustReport {
    pub format: u32,
    /// `pass` if every mutant is caught for a right reason and there is no false alarm, else
    /// `fail`.
    pub verdict: Verdict,
    pub confidence: f64,
    pub kill_rate: Rate,
    pub scenarios: Vec<ScenarioRate>,
    pub faults: Vec<MutantResult>,
    pub clean: FalseAlarmResult,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rate {
    pub seen: u32,
    pub count: u32,
    /// Bounds of the true probability by Clopper and Pearson. `null` if `count` is 0.
    pub bounds: Option<[f64; 2]>,
}

impl Rate {
    pub fn new(seen: usize, count: usize) -> Self {
        let (seen, count) = (seen as u32, count as u32);
        Self { seen, count, bounds: clopper_pearson(seen, count, CONFIDENCE) }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScenarioRate {
    pub file: String,
    pub kill_rate: Rate,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MutantResult {
    pub name: String,
    pub mistake: String,
    pub should_be_caught_by: Vec<String>,
    pub outcome: MutantOutcome,
    /// Failures that should catch the mutant. The reference passes these expectations.
    pub right: Vec<FailedExpectation>,
    /// Failures of other metrics or rules. The reference passes these expectations too.
    pub wrong: Vec<FailedExpectation>,
}

impl MutantResult {
    pub(crate) fn is_caught_by(&self, scenario: &str) -> bool {
        self.right.iter().any(|cell| cell.scenario == scenario)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MutantOutcome {
    Caught,
    /// Only other metrics or rules fail. The mutant then counts as survived.
    WrongReason,
    Survived,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct FailedExpectation {
    pub scenario: String,
    /// Number of the expectation, from 1. It is 0 for a violation of the protocol.
    pub expectation: usize,
    pub metric: String,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalseAlarmResult {
    /// Share of clean runs that fail. Each plays one scenario with another plate and noise.
    pub false_alarm_rate: Rate,
    pub inconclusive: u32,
    pub scenarios: u32,
    pub seed: u64,
    /// Failures of correct controllers in the clean runs and in the unmodified scenarios.
    pub alarms: Vec<FalseAlarm>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalseAlarm {
    /// `reference` or the name of a clean variant.
    pub controller: String,
    /// Number of the clean run, from 0. `null` for an alarm in the unmodified scenarios.
    pub run: Option<u32>,
    pub seed: u64,
    pub cell: FailedExpectation,
}
