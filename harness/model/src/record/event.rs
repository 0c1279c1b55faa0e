//! Defines the events of a run. Sinks receive them in order.

use crate::record::expectation_record::ExpectationRecord;
use crate::record::run_record::ScenarioRecord;
use crate::record::trial_record::TrialRecord;
use crate::record::verdict::Verdict;
use crate::trace::Row;

#[derive(Debug, Clone)]
pub enum Event {
    ScenarioStarted {
        /// Path below the scenario folder.
        file: String,
        trials: u32,
    },
    TrialFinished {
        file: String,
        /// The trace of this trial is complete when the event is sent.
        trial: Box<TrialRecord>,
        /// Rows of the first trials of each scenario if the receiver wants rows; otherwise empty.
        rows: Vec<Row>,
    },
    ScenarioFinished(Box<FinishedScenario>),
}

/// A judged scenario without its trials, which may be many.
#[derive(Debug, Clone)]
pub struct FinishedScenario {
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
