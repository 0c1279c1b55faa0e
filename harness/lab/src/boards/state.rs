//! Locks a board, stores its state so that it survives a power cut, and derives the state from the
//! end of a run.

use crate::boards::inventory::{Board, BoardError, Inventory};
use platebench_engine::RunError;
use platebench_model::record::{
    JOURNAL_FILE, RECORD_FILE, RunRecord, Verdict, is_run_folder, sha256_of_file, utc_timestamp,
};
use platebench_model::trace::{AtPath, FileError, OutputFolder, create_folder, read_text_file, write_atomically};
use platebench_rig::{LockHolder, lock_file};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

const FORMAT: u32 = 1;
const MAX_STATE_BYTES: u64 = 1 << 20;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct StoredState {
    format: u32,
    /// Mark that is present from before the first voltage until the controller has confirmed 0 V.
    pub(crate) in_use: Option<InUse>,
    pub(crate) quarantine: Option<Quarantine>,
    pub(crate) last_run: Option<LastRun>,
    pub(crate) cleared: Option<Clearance>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct InUse {
    pub(crate) since: String,
    pub(crate) process: u32,
    pub(crate) user: Option<String>,
    /// Subcommand of platebench that reserved the board.
    pub(crate) command: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Quarantine {
    pub since: String,
    pub reason: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LastRun {
    pub started: String,
    pub folder: PathBuf,
    pub verdict: Option<Verdict>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct Clearance {
    at: String,
    user: Option<String>,
    reason: String,
    quarantine: Quarantine,
}

impl Default for StoredState {
    fn default() -> Self {
        Self { format: FORMAT, in_use: None, quarantine: None, last_run: None, cleared: None }
    }
}

impl StoredState {
    /// Returns the default if there is no file, because such a board was never in use.
    pub(crate) fn read(path: &Path) -> Result<Self, BoardError> {
        match read_text_file(path, MAX_STATE_BYTES) {
            Ok(text) => {
                serde_json::from_str(&text).map_err(|source| BoardError::State { path: path.to_owned(), source })
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(source) => Err(FileError { path: path.to_owned(), source }.into()),
        }
    }

    pub(crate) fn write(&self, path: &Path) -> Result<(), BoardError> {
        let text =
            serde_json::to_string_pretty(self).map_err(|source| BoardError::State { path: path.to_owned(), source })?;
        Ok(write_atomically(path, format!("{text}\n").as_bytes()).at(path)?)
    }

    /// Without a process that holds the lock, `in_use` means quarantine: 0 V was not confirmed.
    pub(crate) fn quarantine_without_holder(&self) -> Option<Quarantine> {
        let lost = |mark: &InUse| Quarantine {
            since: mark.since.clone(),
            reason: format!("process {} (`platebench {}`) ended without confirmed 0 V", mark.process, mark.command),
        };
        self.quarantine.clone().or_else(|| self.in_use.as_ref().map(lost))
    }

    pub(crate) fn mark_in_use(&mut self, command: &str) {
        let (process, user) = (std::process::id(), current_user());
        self.in_use = Some(InUse { since: utc_timestamp(), process, user, command: command.to_owned() });
    }

    pub(crate) fn clear(&mut self, reason: &str) -> bool {
        let Some(quarantine) = self.quarantine_without_holder() else { return false };
        self.cleared =
            Some(Clearance { at: utc_timestamp(), user: current_user(), reason: reason.to_owned(), quarantine });
        (self.in_use, self.quarantine) = (None, None);
        true
    }
}

fn current_user() -> Option<String> {
    std::env::var("USER").ok().filter(|user| !user.is_empty())
}

#[derive(Debug, Clone)]
pub(crate) struct BoardFiles {
    pub(crate) state: PathBuf,
    locks: Vec<PathBuf>,
}

impl BoardFiles {
    /// Creates the state folder if it does not exist.
    pub(crate) fn new(inventory: &Inventory, board: &Board) -> Result<Self, BoardError> {
        let folder = inventory.state_folder();
        create_folder(&folder).at(&folder)?;
        let probe = board.probe_serial.as_ref().map(|serial| {
            let is_plain = |letter: char| letter.is_ascii_alphanumeric();
            let name: String = serial.chars().map(|letter| if is_plain(letter) { letter } else { '_' }).collect();
            folder.join(format!("{name}.probe.lock"))
        });
        let lock = folder.join(format!("{}.lock", board.name));
        Ok(Self {
            state: folder.join(format!("{}.json", board.name)),
            locks: std::iter::once(lock).chain(probe).collect(),
        })
    }

    pub(crate) fn lock(&self) -> Result<Result<BoardLock, LockHolder>, BoardError> {
        let mut files = Vec::new();
        for path in &self.locks {
            let folder = OutputFolder::open(path.parent().unwrap_or(Path::new("")))?;
            let file = folder.append(path.file_name().unwrap_or_default())?;
            match lock_file(&file).map_err(io::Error::from).at(path)? {
                None => files.push(file),
                Some(holder) => return Ok(Err(holder)),
            }
        }
        Ok(Ok(BoardLock { _files: files }))
    }
}

#[derive(Debug)]
pub(crate) struct BoardLock {
    _files: Vec<File>,
}

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
            Err(_) if is_run_folder(folder) => Self::unconfirmed(),
            Err(_) => Self::untouched(),
        };
        if let RunError::DifferentController { .. } = error {
            end.quarantine = Some(error.to_string());
        }
        end
    }

    /// Combines all runs in and below `folder` except for the `earlier` ones. `last_run` is the
    /// newest of them.
    pub fn of_runs_below(folder: &Path, earlier: &RunsBelow) -> Self {
        let mut end = Self::untouched();
        for (path, digest) in RunsBelow::find(folder).0 {
            if earlier.0.get(&path) == Some(&digest) {
                continue;
            }
            let run = RunRecord::read(&path).map_or_else(|_| Self::unconfirmed(), |run| Self::of_record(&run, &path));
            end.quarantine = end.quarantine.take().or(run.quarantine);
            // If two runs started in the same second, the one with the later folder name counts as
            // newer.
            if run.last_run.as_ref().map(|run| &run.started) >= end.last_run.as_ref().map(|run| &run.started) {
                end.last_run = run.last_run;
            }
        }
        end
    }
}

/// Run folders with the digests of their records. Tells new runs from earlier ones without a clock,
/// because a clock can be set back.
#[derive(Debug, Default)]
pub struct RunsBelow(BTreeMap<PathBuf, [Option<String>; 2]>);

impl RunsBelow {
    /// Finds the runs in and below `folder`, which may be missing.
    pub fn find(folder: &Path) -> Self {
        let mut runs = Self::default();
        runs.add(folder, MAX_DEPTH);
        runs
    }

    fn add(&mut self, folder: &Path, depth: usize) {
        if is_run_folder(folder) {
            let files = [RECORD_FILE, JOURNAL_FILE].map(|file| sha256_of_file(&folder.join(file)).ok());
            self.0.insert(folder.to_owned(), files);
            return;
        }
        let entries = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        entries.filter(|path| depth > 0 && path.is_dir()).for_each(|below| self.add(&below, depth - 1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_records_that_are_new_or_changed_count() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let write = |name: &str, text: &str| std::fs::write(path(name), text).unwrap();
        for run in ["steps", "steps/a", "steps/b"] {
            std::fs::create_dir(path(run)).unwrap();
        }
        write("steps/a/run.json", "cut off");
        let earlier = RunsBelow::find(folder.path());
        let outcome = || BoardOutcome::of_runs_below(folder.path(), &earlier);
        assert_eq!(outcome(), BoardOutcome::untouched());
        write("steps/b/trials.jsonl", "cut off");
        assert_eq!(outcome(), BoardOutcome::unconfirmed());
        std::fs::remove_file(path("steps/b/trials.jsonl")).unwrap();
        assert_eq!(outcome(), BoardOutcome::untouched());
        // A repeated step has the folder of the earlier one.
        write("steps/a/run.json", "cut off elsewhere");
        assert_eq!(outcome(), BoardOutcome::unconfirmed());
    }
}
