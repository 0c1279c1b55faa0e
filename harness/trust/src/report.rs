//! What came of it, as JSON has it.

use platebench_verdict::Verdict;
use platebench_verdict::statistics::proportion::clopper_pearson;
use serde::Serialize;

/// Of every bound here, one-sided.
pub const CONFIDENCE: f64 = 0.95;

/// The bench's own error rates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Version of this format.
    pub format: u32,
    /// `pass` where no fault survived and no clean run failed, else `fail`.
    pub verdict: Verdict,
    /// Of the bounds, each one-sided.
    pub confidence: f64,
    /// How many of the catalogue's faults the scenarios together catch for a right reason.
    pub kill_rate: Rate,
    /// The same for each scenario by itself.
    pub scenarios: Vec<ScenarioRate>,
    /// What became of each fault.
    pub faults: Vec<FaultOutcome>,
    /// How often clean controllers were called faulty.
    pub clean: Clean,
}

/// How often something was seen, and what that says of its probability.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rate {
    /// How often.
    pub seen: u32,
    /// Of how many.
    pub count: u32,
    /// Bounds of its probability by Clopper and Pearson; `null` where nothing was tried.
    pub bounds: Option<[f64; 2]>,
}

impl Rate {
    /// Of what was seen `seen` times in `count` tries.
    pub fn of(seen: usize, count: usize) -> Self {
        let (seen, count) = (seen as u32, count as u32);
        Self { seen, count, bounds: clopper_pearson(seen, count, CONFIDENCE) }
    }
}

/// What one scenario catches.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScenarioRate {
    /// Its file.
    pub file: String,
    /// How many faults it catches for a right reason.
    pub kill_rate: Rate,
}

/// What became of one fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultOutcome {
    /// Its name.
    pub name: String,
    /// What somebody did.
    pub mistake: String,
    /// The metrics by which it should be caught.
    pub should_be_caught_by: Vec<String>,
    /// Caught for a right reason, for a wrong one alone, or not at all.
    pub outcome: Outcome,
    /// Expectations on those metrics that failed, and do not without the mistake.
    pub right: Vec<Cell>,
    /// Others that failed, and do not without the mistake.
    pub wrong: Vec<Cell>,
}

/// How a fault ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// By a metric by which it should be.
    Caught,
    /// By others alone; counted as a survivor.
    WrongReason,
    /// By nothing.
    Survived,
}

/// One expectation of one scenario.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Cell {
    /// The scenario's file.
    pub scenario: String,
    /// Number of the expectation in it, from 1.
    pub expectation: usize,
    /// Its metric.
    pub metric: String,
}

/// How often clean controllers were called faulty.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Clean {
    /// Runs that failed, of those that were played. A run is one scenario with a plate and noise of its own.
    pub false_alarm_rate: Rate,
    /// Runs that ended in doubt.
    pub inconclusive: u32,
    /// Scenarios that were played so.
    pub scenarios: u32,
    /// Seed of the first run.
    pub seed: u64,
    /// What failed, of the runs above and of the suite as it stands.
    pub alarms: Vec<Alarm>,
}

/// A clean controller that was called faulty.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Alarm {
    /// Number of the run, from 0; `null` for the suite as it stands.
    pub run: Option<u32>,
    /// Seed of its first trial.
    pub seed: u64,
    /// What called it so.
    pub cell: Cell,
}
