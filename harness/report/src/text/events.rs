//! Writes the events of a run as lines of JSON (`docs/formats.md`), flushed at once.

use crate::escape::json_line;
use crate::format::VerdictCounts;
use crate::record_queries::own_verdict_of_run;
use platebench_model::record::{Event, ExpectationRecord, RunRecord, TrialRecord, Verdict};
use schemars::JsonSchema;
use serde::Serialize;
use std::io::Write;

pub const FORMAT: u32 = 1;

/// A line of the events of a run.
#[derive(Debug, Serialize, JsonSchema)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum EventLine<'a> {
    /// The first line of a run that starts.
    RunStarted {
        /// Version of the format.
        format: u32,
        /// The run folder.
        folder: &'a str,
        /// As named on the command line.
        rig: &'a str,
        clock: &'a str,
        scenarios: Vec<PlannedScenario<'a>>,
    },
    ScenarioStarted {
        /// Its file below the scenario folder.
        scenario: &'a str,
        /// The initial number; `max_count` may add more.
        trials: u32,
    },
    TrialFinished {
        scenario: &'a str,
        trial: &'a TrialRecord,
    },
    ScenarioFinished {
        scenario: &'a str,
        title: &'a str,
        law: &'a str,
        verdict: Verdict,
        trials: usize,
        expectations: &'a [ExpectationRecord],
    },
    /// The last line.
    RunFinished {
        verdict: Verdict,
        /// False if the run was cut short.
        complete: bool,
        exit_code: u8,
        /// Why there is no verdict.
        error: Option<&'a str>,
        /// Reason of a verdict that no scenario has.
        #[serde(skip_serializing_if = "Option::is_none")]
        reason: Option<String>,
        scenarios: VerdictCounts,
        expectations: VerdictCounts,
    },
}

#[derive(Debug, Serialize, JsonSchema)]
pub struct PlannedScenario<'a> {
    scenario: &'a str,
    trials: u32,
}

/// Writes event lines. A closed pipe is no error.
pub struct EventWriter {
    out: Box<dyn Write + Send>,
}

impl EventWriter {
    pub fn new(out: impl Write + Send + 'static) -> Self {
        Self { out: Box::new(out) }
    }

    pub fn run_started(&mut self, folder: &str, rig: &str, clock: &str, scenarios: &[(String, u32)]) {
        let scenarios = scenarios.iter().map(|(file, trials)| PlannedScenario { scenario: file, trials: *trials });
        self.write(&EventLine::RunStarted { format: FORMAT, folder, rig, clock, scenarios: scenarios.collect() });
    }

    pub fn event(&mut self, event: &Event) {
        self.write(&match event {
            Event::ScenarioStarted { file, trials } => EventLine::ScenarioStarted { scenario: file, trials: *trials },
            Event::TrialFinished { file, trial, .. } => EventLine::TrialFinished { scenario: file, trial },
            Event::ScenarioFinished(scenario) => EventLine::ScenarioFinished {
                scenario: &scenario.file,
                title: &scenario.title,
                law: &scenario.law,
                verdict: scenario.verdict,
                trials: scenario.trial_count,
                expectations: &scenario.expectations,
            },
        });
    }

    /// Without a record there is no verdict, and `error` is the reason.
    pub fn run_finished(&mut self, record: Option<&RunRecord>, error: Option<&str>, exit_code: u8) {
        self.write(&EventLine::RunFinished {
            verdict: record.map_or(Verdict::Inconclusive, |record| record.verdict),
            complete: record.is_some_and(|record| record.complete),
            exit_code,
            error,
            reason: record.and_then(own_verdict_of_run).map(|own| own.reason),
            scenarios: record.map(VerdictCounts::of_scenarios).unwrap_or_default(),
            expectations: record.map(VerdictCounts::of_expectations).unwrap_or_default(),
        });
    }

    fn write(&mut self, line: &EventLine<'_>) {
        if let Ok(value) = serde_json::to_value(line) {
            let _ = writeln!(self.out, "{}", json_line(&value)).and_then(|()| self.out.flush());
        }
    }
}
