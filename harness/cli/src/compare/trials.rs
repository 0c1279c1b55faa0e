//! Lists the stored trials of a run; rows are read trial by trial, so that memory does not grow with their number.

use platebench_record::{RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord};
use platebench_runner::RejudgeError;
use platebench_runner::rejudge::read_trial_rows;
use platebench_trace::{Row, TraceError, read_trace};
use platebench_verdict::golden::BaselineError;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub(crate) enum CompareError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    #[error("{}: a trace outside a run folder has no scenario, expected --against FILE.toml of a baseline", .0.display())]
    NoScenario(PathBuf),
    #[error("{}: {count} scenarios, expected a run of one scenario as the reference of a trace", path.display())]
    SeveralScenarios { path: PathBuf, count: usize },
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
}

/// The trials of a scenario that can be compared.
pub(crate) struct ScenarioTrials {
    /// The file of the scenario or of the trace.
    pub(crate) name: String,
    pub(crate) trials: Vec<StoredTrial>,
    /// The reason for each trial that does not count.
    pub(crate) excluded: Vec<String>,
}

/// A trial and where its rows are stored.
pub(crate) struct StoredTrial {
    pub(crate) index: u32,
    source: TraceSource,
}

enum TraceSource {
    File(PathBuf),
    Run { folder: PathBuf, trial: Box<TrialRecord> },
}

impl StoredTrial {
    /// Reads the rows.
    pub(crate) fn rows(&self) -> Result<Vec<Row>, CompareError> {
        match &self.source {
            TraceSource::File(path) => Ok(read_trace(path)?),
            TraceSource::Run { folder, trial } => Ok(read_trial_rows(folder, trial)?),
        }
    }
}

pub(super) fn is_run_folder(path: &Path) -> bool {
    path.join(RECORD_FILE).exists() || path.is_dir()
}

/// The trials of a run folder, or one trace.
pub(super) fn read_trials(path: &Path) -> Result<Vec<ScenarioTrials>, CompareError> {
    if !is_run_folder(path) {
        let trials = vec![StoredTrial { index: 0, source: TraceSource::File(path.to_owned()) }];
        return Ok(vec![ScenarioTrials { name: path.display().to_string(), trials, excluded: Vec::new() }]);
    }
    Ok(RunRecord::read(path)?.scenarios.iter().map(|scenario| read_scenario_trials(path, scenario)).collect())
}

/// The trials of a scenario in the run folder.
pub(crate) fn read_scenario_trials(folder: &Path, scenario: &ScenarioRecord) -> ScenarioTrials {
    let mut found = ScenarioTrials { name: scenario.file.clone(), trials: Vec::new(), excluded: Vec::new() };
    for trial in &scenario.trials {
        if let Some(cause) = trial.cause {
            let reason = trial.reason.as_ref().map_or_else(|| "it was disturbed".to_owned(), ToString::to_string);
            found.excluded.push(format!("trial {} does not count ({cause}): {reason}", trial.index));
        } else {
            let source = TraceSource::Run { folder: folder.to_owned(), trial: Box::new(trial.clone()) };
            found.trials.push(StoredTrial { index: trial.index, source });
        }
    }
    found
}
