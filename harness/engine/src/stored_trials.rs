//! Lists the stored trials of a run. Reads the rows of one trial at a time to limit memory.

use crate::rejudge::{RejudgeError, load_stored_scenario, read_trial_rows};
use platebench_model::record::{RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord};
use platebench_model::trace::{FileError, Row, TraceError, read_trace};
use platebench_verdict::golden::BaselineError;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    #[error("{}: this trace is not in a run folder, so its scenario is unknown; \
        expected --against BASELINE.toml", .0.display())]
    NoScenario(PathBuf),
    #[error("{}: the run has {count} scenarios, expected one: a single trace is compared with it", path.display())]
    SeveralScenarios { path: PathBuf, count: usize },
    #[error(transparent)]
    File(#[from] FileError),
}

pub struct ScenarioTrials {
    /// Scenario file as in `run.json`, or path of the trace if the trials are a single trace.
    pub name: String,
    pub trials: Vec<StoredTrial>,
    pub excluded: Vec<String>,
}

pub struct StoredTrial {
    pub index: u32,
    /// Largest time between two rows that the scenario allows, ms. `None` if it is unknown.
    pub row_step_ms: Option<f64>,
    source: TraceSource,
}

enum TraceSource {
    File(PathBuf),
    Run { folder: PathBuf, trial: Box<TrialRecord> },
}

impl StoredTrial {
    pub fn rows(&self) -> Result<Vec<Row>, CompareError> {
        match &self.source {
            TraceSource::File(path) => Ok(read_trace(path)?),
            TraceSource::Run { folder, trial } => Ok(read_trial_rows(folder, trial)?),
        }
    }

    /// False if the controller was lost, so that the rest of the trace is a plate at 0 V.
    pub(crate) fn is_complete(&self) -> bool {
        match &self.source {
            TraceSource::File(_) => true,
            TraceSource::Run { trial, .. } => trial.telemetry.ended.is_none(),
        }
    }
}

pub fn is_run_folder(path: &Path) -> bool {
    path.join(RECORD_FILE).exists() || path.is_dir()
}

pub fn read_trials(path: &Path) -> Result<Vec<ScenarioTrials>, CompareError> {
    if !is_run_folder(path) {
        let trials = vec![StoredTrial { index: 0, row_step_ms: None, source: TraceSource::File(path.to_owned()) }];
        return Ok(vec![ScenarioTrials { name: path.display().to_string(), trials, excluded: Vec::new() }]);
    }
    Ok(RunRecord::read(path)?.scenarios.iter().map(|scenario| read_scenario_trials(path, scenario)).collect())
}

pub fn read_scenario_trials(folder: &Path, scenario: &ScenarioRecord) -> ScenarioTrials {
    let played = load_stored_scenario(folder, scenario).ok();
    let mut trials = ScenarioTrials { name: scenario.file.clone(), trials: Vec::new(), excluded: Vec::new() };
    for trial in &scenario.trials {
        if let Some(cause) = trial.cause {
            let reason = trial.reason.as_ref().map_or_else(|| "it was disturbed".to_owned(), ToString::to_string);
            trials.excluded.push(format!("trial {} does not count ({cause}): {reason}", trial.index));
        } else {
            let source = TraceSource::Run { folder: folder.to_owned(), trial: Box::new(trial.clone()) };
            // A real plate has one row per control period.
            let period = trial.telemetry.real_plate.as_ref().and(scenario.period_ms).unwrap_or_default();
            let row_step_ms = played.as_ref().map(|played| played.trace_step.ms().max(period));
            trials.trials.push(StoredTrial { index: trial.index, row_step_ms, source });
        }
    }
    trials
}
