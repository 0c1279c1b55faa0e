//! Writes the events of a run as lines of JSON (`docs/formats.md`), flushed at once.

use super::escape::json_line;
use crate::format::VerdictCounts;
use platebench_record::{RunRecord, ScenarioRecord, TrialRecord, Verdict};
use serde_json::{Value, json};
use std::io::Write;

/// Readers refuse other versions.
pub const FORMAT: u32 = 1;

/// A closed pipe is no error.
pub struct EventWriter {
    out: Box<dyn Write + Send>,
}

impl EventWriter {
    pub fn new(out: impl Write + Send + 'static) -> Self {
        Self { out: Box::new(out) }
    }

    pub fn run_started(&mut self, folder: &str, rig: &str, clock: &str, scenarios: &[(String, u32)]) {
        let scenarios: Vec<_> =
            scenarios.iter().map(|(file, trials)| json!({"scenario": file, "trials": trials})).collect();
        self.write(&json!({
            "event": "run-started", "format": FORMAT, "folder": folder, "rig": rig, "clock": clock, "scenarios": scenarios,
        }));
    }

    pub fn scenario_started(&mut self, file: &str, trials: u32) {
        self.write(&json!({"event": "scenario-started", "scenario": file, "trials": trials}));
    }

    pub fn trial_finished(&mut self, file: &str, trial: &TrialRecord) {
        self.write(&json!({"event": "trial-finished", "scenario": file, "trial": trial}));
    }

    pub fn scenario_finished(&mut self, scenario: &ScenarioRecord) {
        self.write(&json!({
            "event": "scenario-finished", "scenario": scenario.file, "title": scenario.title, "law": scenario.law,
            "verdict": scenario.verdict, "trials": scenario.trials.len(), "expectations": scenario.expectations,
        }));
    }

    /// Without a record there is no verdict, and `error` is the reason.
    pub fn run_finished(&mut self, record: Option<&RunRecord>, error: Option<&str>, exit_code: u8) {
        let count = |counts: VerdictCounts| json!({"passed": counts.passed, "failed": counts.failed, "inconclusive": counts.inconclusive});
        self.write(&json!({
            "event": "run-finished",
            "verdict": record.map_or(Verdict::Inconclusive, |record| record.verdict),
            "complete": record.is_some_and(|record| record.complete),
            "exit_code": exit_code,
            "error": error,
            "scenarios": count(record.map(VerdictCounts::of_scenarios).unwrap_or_default()),
            "expectations": count(record.map(VerdictCounts::of_expectations).unwrap_or_default()),
        }));
    }

    fn write(&mut self, line: &Value) {
        let _ = writeln!(self.out, "{}", json_line(line)).and_then(|()| self.out.flush());
    }
}
