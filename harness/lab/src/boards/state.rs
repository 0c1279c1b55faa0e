//! Stores the state of a board so that it survives a power cut.

use crate::boards::error::BoardError;
use platebench_model::record::{Verdict, utc_timestamp};
use platebench_model::trace::{AtPath, FileError, read_text_file, write_atomically};
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

const FORMAT: u32 = 1;
const MAX_STATE_BYTES: u64 = 1 << 20;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredState {
    format: u32,
    /// Mark that is present from before the first voltage until the controller has confirmed 0 V.
    pub(crate) in_use: Option<InUse>,
    pub(crate) quarantine: Option<Quarantine>,
    pub(crate) last_run: Option<LastRun>,
    pub(crate) cleared: Option<Clearance>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct InUse {
    pub(crate) since: String,
    pub(crate) process: u32,
    pub(crate) user: Option<String>,
    /// Subcommand of platebench that reserved the board.
    pub(crate) command: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Quarantine {
    pub since: String,
    pub reason: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastRun {
    pub started: String,
    pub folder: PathBuf,
    pub verdict: Option<Verdict>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
