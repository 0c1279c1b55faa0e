//! Names what happens during a run; sinks receive the events in order.

use crate::run_record::ScenarioRecord;
use crate::trial_record::TrialRecord;
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
    ScenarioFinished(Box<ScenarioRecord>),
}
