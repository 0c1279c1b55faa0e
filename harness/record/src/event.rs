//! Names what happens during a run; sinks receive the events in order.

use crate::expectation_record::ExpectationRecord;
use crate::run_record::ScenarioRecord;
use crate::trial_record::TrialRecord;
use crate::verdict::Verdict;
use platebench_trace::Row;

#[derive(Debug, Clone)]
pub enum Event {
    ScenarioStarted {
        /// Below the scenario folder.
        file: String,
        trials: u32,
    },
    TrialFinished {
        file: String,
        /// Its trace is complete.
        trial: Box<TrialRecord>,
        /// Rows of the first trials of each scenario, if the receiver wants them.
        rows: Vec<Row>,
    },
    /// All trials of a scenario ended and are judged.
    ScenarioFinished(Box<FinishedScenario>),
}

/// A judged scenario without its trials, which may be many.
#[derive(Debug, Clone)]
pub struct FinishedScenario {
    /// Below the scenario folder.
    pub file: String,
    pub title: String,
    pub law: String,
    pub verdict: Verdict,
    pub trial_count: usize,
    pub expectations: Vec<ExpectationRecord>,
}

impl From<&ScenarioRecord> for FinishedScenario {
    fn from(record: &ScenarioRecord) -> Self {
        Self {
            file: record.file.clone(),
            title: record.title.clone(),
            law: record.law.clone(),
            verdict: record.verdict,
            trial_count: record.trials.len(),
            expectations: record.expectations.clone(),
        }
    }
}
