//! Names what happens during a run. Sinks (console, JSON lines, live view) receive the events in
//! order.

use crate::run_record::ScenarioRecord;
use crate::trial_record::TrialRecord;

/// Something that happened during a run.
#[derive(Debug, Clone)]
pub enum Event {
    /// The first trial of a scenario began.
    ScenarioStarted {
        /// Its file below the scenario folder.
        file: String,
        /// Number of its trials.
        trials: u32,
    },
    /// A trial ended and its trace is complete.
    TrialFinished {
        /// The scenario's file.
        file: String,
        /// The trial.
        trial: Box<TrialRecord>,
    },
    /// All trials of a scenario ended and are judged.
    ScenarioFinished(Box<ScenarioRecord>),
}
