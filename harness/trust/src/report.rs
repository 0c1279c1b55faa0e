//! Defines the report (`trust.json`).

use platebench_record::Verdict;
use platebench_verdict::statistics::proportion::clopper_pearson;
use serde::Serialize;

/// One-sided confidence of each bound.
pub const CONFIDENCE: f64 = 0.95;

/// The bench's own error rates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrustReport {
    /// Version of this format.
    pub format: u32,
    /// `pass` if no mutant survived and no clean run failed, otherwise `fail`.
    pub verdict: Verdict,
    /// One-sided confidence of each bound.
    pub confidence: f64,
    /// Mutants that the suite catches for the right reason.
    pub kill_rate: Rate,
    /// The same for each scenario.
    pub scenarios: Vec<ScenarioRate>,
    /// The result of each mutant.
    pub faults: Vec<MutantResult>,
    /// Failures of clean controllers.
    pub clean: FalseAlarmResult,
}

/// A count and the bounds of its probability.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rate {
    /// Number of events.
    pub seen: u32,
    /// Number of tries.
    pub count: u32,
    /// Bounds of the probability by Clopper and Pearson; `null` without tries.
    pub bounds: Option<[f64; 2]>,
}

impl Rate {
    /// The rate of `seen` events in `count` tries.
    pub fn new(seen: usize, count: usize) -> Self {
        let (seen, count) = (seen as u32, count as u32);
        Self { seen, count, bounds: clopper_pearson(seen, count, CONFIDENCE) }
    }
}

/// Mutants caught by one scenario.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScenarioRate {
    /// Its file.
    pub file: String,
    /// Mutants that it catches for the right reason.
    pub kill_rate: Rate,
}

/// Result of one mutant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MutantResult {
    /// Its name.
    pub name: String,
    /// Its mistake.
    pub mistake: String,
    /// The metrics that should detect it.
    pub should_be_caught_by: Vec<String>,
    /// Caught or not.
    pub outcome: MutantOutcome,
    /// Failed expectations on these metrics that the reference passes.
    pub right: Vec<FailedExpectation>,
    /// Other failed expectations that the reference passes.
    pub wrong: Vec<FailedExpectation>,
}

/// Outcome of a mutant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MutantOutcome {
    /// A metric that should detect it failed.
    Caught,
    /// Only other metrics failed; counted as a survivor.
    WrongReason,
    /// Nothing failed.
    Survived,
}

/// An expectation of a scenario.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct FailedExpectation {
    /// The scenario's file.
    pub scenario: String,
    /// Number of the expectation in it, from 1.
    pub expectation: usize,
    /// Its metric.
    pub metric: String,
}

/// Failures of clean controllers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalseAlarmResult {
    /// Failed runs. A run is one scenario with its own plate and noise.
    pub false_alarm_rate: Rate,
    /// Inconclusive runs.
    pub inconclusive: u32,
    /// Number of scenarios.
    pub scenarios: u32,
    /// Seed of the first run.
    pub seed: u64,
    /// Failed expectations of these runs and of the unmodified suite.
    pub alarms: Vec<FalseAlarm>,
}

/// A failed expectation of a clean controller.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalseAlarm {
    /// The controller: `reference` or a clean variant.
    pub controller: String,
    /// Number of the run, from 0; `null` for the unmodified suite.
    pub run: Option<u32>,
    /// Seed of its first trial.
    pub seed: u64,
    /// The expectation.
    pub cell: FailedExpectation,
}
