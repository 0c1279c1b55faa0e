//! Defines the events of a run. Each is also a line of `run --format json` (`docs/formats.md`).

use crate::record::reason::ExpectationRecord;
use crate::record::run_record::{RunRecord, ScenarioRecord};
use crate::record::trial_record::TrialRecord;
use crate::record::verdict::{Verdict, VerdictCounts};
use crate::trace::Row;
use schemars::JsonSchema;
use serde::Serialize;

/// A line of the events of a run.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum Event {
    /// The first line of a run that starts.
    RunStarted {
        /// Version of the format.
        format: u32,
        /// The run folder.
        folder: String,
        /// As named on the command line.
        rig: String,
        clock: String,
        scenarios: Vec<PlannedScenario>,
    },
    ScenarioStarted {
        /// Its file below the scenario folder.
        scenario: String,
        /// The initial number; `max_count` may add more.
        trials: u32,
    },
    // The trace of the trial is complete when the event is sent.
    TrialFinished {
        scenario: String,
        trial: Box<TrialRecord>,
        // Rows of the first trials of each scenario if the receiver wants rows; otherwise empty.
        #[serde(skip)]
        rows: Vec<Row>,
    },
    // A judged scenario without its trials, which may be many.
    ScenarioFinished {
        scenario: String,
        title: String,
        law: String,
        verdict: Verdict,
        trials: usize,
        expectations: Vec<ExpectationRecord>,
    },
    /// The last line.
    RunFinished {
        verdict: Verdict,
        /// False if the run was cut short.
        complete: bool,
        exit_code: u8,
        /// Why there is no verdict.
        error: Option<String>,
        /// Reason of a verdict that no scenario has.
        #[serde(skip_serializing_if = "Option::is_none")]
        reason: Option<String>,
        scenarios: VerdictCounts,
        expectations: VerdictCounts,
    },
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct PlannedScenario {
    pub scenario: String,
    pub trials: u32,
}

impl Event {
    /// Version of the lines.
    pub const FORMAT: u32 = 1;

    pub fn scenario_finished(record: &ScenarioRecord) -> Self {
        Self::ScenarioFinished {
            scenario: record.file.clone(),
            title: record.title.clone(),
            law: record.law.clone(),
            verdict: record.verdict,
            trials: record.trials.len(),
            expectations: record.expectations.clone(),
        }
    }

    /// Without a record there is no verdict, and `error` is the reason.
    pub fn run_finished(
        record: Option<&RunRecord>,
        error: Option<&str>,
        reason: Option<String>,
        exit_code: u8,
    ) -> Self {
        Self::RunFinished {
            verdict: record.map_or(Verdict::Inconclusive, |record| record.verdict),
            complete: record.is_some_and(|record| record.complete),
            exit_code,
            error: error.map(str::to_owned),
            reason,
            scenarios: record.map(RunRecord::scenario_counts).unwrap_or_default(),
            expectations: record.map(RunRecord::expectation_counts).unwrap_or_default(),
        }
    }
}
