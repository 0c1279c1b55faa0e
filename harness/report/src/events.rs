//! A run as lines of JSON while it goes on: one object a line, the last of them the verdict.
//!
//! docs/formats.md says what each line holds; its names are kept. Every line is written at once, so that whoever reads
//! sees it when it happens.
//!
//! Neighbours: whoever receives the events of a run calls this, from one thread, as it does with progress.

use crate::shown::Counts;
use platebench_verdict::{RunRecord, ScenarioRecord, TrialRecord, Verdict};
use serde_json::{Value, json};
use std::io::Write;

/// Version of the lines; readers refuse others.
pub const FORMAT: u32 = 1;

/// Writes what happens in a run. A reader who went away is no error.
pub struct Events {
    out: Box<dyn Write + Send>,
}

impl Events {
    /// Events to wherever `out` leads.
    pub fn new(out: impl Write + Send + 'static) -> Self {
        Self { out: Box::new(out) }
    }

    /// The run begins: scenarios by file, each with the trials that it begins with.
    pub fn run_started(&mut self, folder: &str, rig: &str, clock: &str, scenarios: &[(String, u32)]) {
        let scenarios: Vec<_> =
            scenarios.iter().map(|(file, trials)| json!({"scenario": file, "trials": trials})).collect();
        self.write(&json!({
            "event": "run-started", "format": FORMAT, "folder": folder, "rig": rig, "clock": clock, "scenarios": scenarios,
        }));
    }

    /// A scenario's first trial begins.
    pub fn scenario_started(&mut self, file: &str, trials: u32) {
        self.write(&json!({"event": "scenario-started", "scenario": file, "trials": trials}));
    }

    /// A trial has ended and its trace is whole.
    pub fn trial_finished(&mut self, file: &str, trial: &TrialRecord) {
        self.write(&json!({"event": "trial-finished", "scenario": file, "trial": trial}));
    }

    /// A scenario is judged.
    pub fn scenario_finished(&mut self, scenario: &ScenarioRecord) {
        self.write(&json!({
            "event": "scenario-finished", "scenario": scenario.file, "title": scenario.title, "law": scenario.law,
            "verdict": scenario.verdict, "trials": scenario.trials.len(), "expectations": scenario.expectations,
        }));
    }

    /// The last line: how the run ended. Without a record it did not come to a verdict, and `error` says why.
    pub fn run_finished(&mut self, record: Option<&RunRecord>, error: Option<&str>, exit_code: u8) {
        let count = |counts: Counts| json!({"passed": counts.passed, "failed": counts.failed, "inconclusive": counts.inconclusive});
        self.write(&json!({
            "event": "run-finished",
            "verdict": record.map_or(Verdict::Inconclusive, |record| record.verdict),
            "complete": record.is_some_and(|record| record.complete),
            "exit_code": exit_code,
            "error": error,
            "scenarios": count(record.map(Counts::of_scenarios).unwrap_or_default()),
            "expectations": count(record.map(Counts::of_expectations).unwrap_or_default()),
        }));
    }

    fn write(&mut self, line: &Value) {
        // Nobody is left to tell.
        let _ = writeln!(self.out, "{line}").and_then(|()| self.out.flush());
    }
}
