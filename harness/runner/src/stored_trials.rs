//! Lists the stored trials of a run. Rows are read trial by trial, so that memory does not grow with their number.

use crate::rejudge::{RejudgeError, read_trial_rows};
use platebench_record::{RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord};
use platebench_trace::{Row, TraceError, read_trace};
use platebench_verdict::golden::BaselineError;
use std::path::{Path, PathBuf};

/// Why stored responses cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// A run folder has no readable record.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A trace cannot be read.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// A trace of a run cannot be used.
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    /// A baseline cannot be read or written.
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    /// A trace has no scenario, and so no baseline.
    #[error("{}: this trace is not in a run folder, so its scenario is unknown; expected --against BASELINE.toml", .0.display())]
    NoScenario(PathBuf),
    /// One trace is compared with a run of several scenarios.
    #[error("{}: {count} scenarios, expected a run of one scenario as the reference of a trace", path.display())]
    SeveralScenarios {
        /// The run folder.
        path: PathBuf,
        /// Its scenarios.
        count: usize,
    },
    /// A file or folder cannot be used.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
}

/// The trials of a scenario that can be compared.
pub struct ScenarioTrials {
    /// The file of the scenario or of the trace.
    pub name: String,
    /// The trials that count.
    pub trials: Vec<StoredTrial>,
    /// The reason for each trial that does not count.
    pub excluded: Vec<String>,
}

/// A stored trial.
pub struct StoredTrial {
    /// Its number, from 0.
    pub index: u32,
    source: TraceSource,
}

enum TraceSource {
    File(PathBuf),
    Run { folder: PathBuf, trial: Box<TrialRecord> },
}

impl StoredTrial {
    /// Reads the rows.
    ///
    /// # Errors
    /// [`CompareError`].
    pub fn rows(&self) -> Result<Vec<Row>, CompareError> {
        match &self.source {
            TraceSource::File(path) => Ok(read_trace(path)?),
            TraceSource::Run { folder, trial } => Ok(read_trial_rows(folder, trial)?),
        }
    }
}

/// True if `path` is a run folder and not a trace.
pub fn is_run_folder(path: &Path) -> bool {
    path.join(RECORD_FILE).exists() || path.is_dir()
}

/// The trials of a run folder, or one trace.
///
/// # Errors
/// [`CompareError::Record`].
pub fn read_trials(path: &Path) -> Result<Vec<ScenarioTrials>, CompareError> {
    if !is_run_folder(path) {
        let trials = vec![StoredTrial { index: 0, source: TraceSource::File(path.to_owned()) }];
        return Ok(vec![ScenarioTrials { name: path.display().to_string(), trials, excluded: Vec::new() }]);
    }
    Ok(RunRecord::read(path)?.scenarios.iter().map(|scenario| read_scenario_trials(path, scenario)).collect())
}

/// The trials of a scenario in the run folder.
pub fn read_scenario_trials(folder: &Path, scenario: &ScenarioRecord) -> ScenarioTrials {
    let mut trials = ScenarioTrials { name: scenario.file.clone(), trials: Vec::new(), excluded: Vec::new() };
    for trial in &scenario.trials {
        if let Some(cause) = trial.cause {
            let reason = trial.reason.as_ref().map_or_else(|| "it was disturbed".to_owned(), ToString::to_string);
            trials.excluded.push(format!("trial {} does not count ({cause}): {reason}", trial.index));
        } else {
            let source = TraceSource::Run { folder: folder.to_owned(), trial: Box::new(trial.clone()) };
            trials.trials.push(StoredTrial { index: trial.index, source });
        }
    }
    trials
}
