//! Decides after a run whether the board goes into quarantine.

use crate::boards::state::LastRun;
use platebench_engine::RunError;
use platebench_model::record::{RECORD_FILE, RunRecord};
use std::fs;
use std::path::Path;

const NOT_CONFIRMED: &str = "the controller did not confirm 0 V";
/// Runs of an acceptance session lie at most this number of folders below the session's folder.
const MAX_DEPTH: usize = 4;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct BoardOutcome {
    /// Reason why no further run may start on the board.
    pub quarantine: Option<String>,
    pub last_run: Option<LastRun>,
}

impl BoardOutcome {
    /// Outcome of a command that applied no voltage.
    pub fn untouched() -> Self {
        Self::default()
    }

    pub fn unconfirmed() -> Self {
        Self { quarantine: Some(NOT_CONFIRMED.to_owned()), last_run: None }
    }

    /// An error of the bench leaves the board usable if the controller confirmed 0 V.
    pub fn of_run(result: Result<&RunRecord, &RunError>, folder: &Path) -> Self {
        match result {
            Ok(record) => Self::of_record(record, folder),
            Err(error) => Self::of_error(error, folder),
        }
    }

    fn of_record(record: &RunRecord, folder: &Path) -> Self {
        let quarantine = if record.safe_confirmed != Some(true) {
            Some(record.unsafe_end().unwrap_or(NOT_CONFIRMED).to_owned())
        } else if record.has_lost_controller() {
            Some("the controller was lost during a trial".to_owned())
        } else {
            None
        };
        let folder = fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
        let verdict = record.complete.then_some(record.verdict);
        Self { quarantine, last_run: Some(LastRun { started: record.started.clone(), folder, verdict }) }
    }

    /// A run without a record ended before the bench configured the controller.
    fn of_error(error: &RunError, folder: &Path) -> Self {
        let mut end = match RunRecord::read(folder) {
            Ok(record) => Self::of_record(&record, folder),
            Err(_) if folder.join(RECORD_FILE).exists() => Self::unconfirmed(),
            Err(_) => Self::untouched(),
        };
        if let RunError::DifferentController { .. } = error {
            end.quarantine = Some(error.to_string());
        }
        end
    }

    /// Combines all runs in and below `folder` from `since` on. `last_run` is the newest of them.
    pub fn of_runs_below(folder: &Path, since: &str) -> Self {
        let mut end = Self::untouched();
        end.add_runs_below(folder, since, MAX_DEPTH);
        end
    }

    fn add_runs_below(&mut self, folder: &Path, since: &str, depth: usize) {
        if folder.join(RECORD_FILE).exists() {
            let run = match RunRecord::read(folder) {
                Ok(record) if record.started.as_str() < since => return,
                Ok(record) => Self::of_record(&record, folder),
                Err(_) => Self::unconfirmed(),
            };
            self.quarantine = self.quarantine.take().or(run.quarantine);
            // If two runs started in the same second, the one with the later folder name counts as
            // newer.
            if run.last_run.as_ref().map(|run| &run.started) >= self.last_run.as_ref().map(|run| &run.started) {
                self.last_run = run.last_run;
            }
            return;
        }
        let entries = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        let mut folders: Vec<_> = entries.filter(|path| depth > 0 && path.is_dir()).collect();
        folders.sort_unstable();
        for below in folders {
            self.add_runs_below(&below, since, depth - 1);
        }
    }
}
