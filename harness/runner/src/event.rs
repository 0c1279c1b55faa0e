//! What a run says while it goes on. One stream; whoever listens decides what becomes of it.

use platebench_verdict::{ScenarioRecord, TrialRecord};

/// Something happened.
#[derive(Debug, Clone)]
pub enum Event {
    /// A scenario's first trial has begun.
    ScenarioStarted {
        /// Its file below the scenario folder.
        file: String,
        /// How many trials it will have.
        trials: u32,
    },
    /// A trial has ended and its trace is whole.
    TrialFinished {
        /// The scenario's file.
        file: String,
        /// The trial.
        trial: Box<TrialRecord>,
    },
    /// All trials of a scenario have ended and are judged.
    ScenarioFinished(Box<ScenarioRecord>),
}
