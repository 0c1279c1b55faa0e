//! Records as files: `run.json` in its run folder, and the runs whose folders lie beside each other.

use super::{FORMAT, RunRecord};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// The record's name in a run folder.
pub const FILE: &str = "run.json";
/// More earlier runs than these are not read.
const NEWEST: usize = 20;

/// Why a record could not be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file is not there or cannot be read.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: String,
        /// What the system says.
        source: io::Error,
    },
    /// The file is not a run record.
    #[error("{path}:{}:{}: {source}", source.line(), source.column())]
    Content {
        /// The file.
        path: String,
        /// What the parser says.
        source: serde_json::Error,
    },
    /// Another version of the format.
    #[error("{path}: format {found}, expected {FORMAT}")]
    Format {
        /// The file.
        path: String,
        /// What it says it is.
        found: u32,
    },
}

impl RunRecord {
    /// Writes the record into `folder`, replacing an earlier one as a whole.
    ///
    /// # Errors
    /// What the system says.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        let provisional = folder.join("run.json.part");
        fs::write(&provisional, text)?;
        fs::rename(&provisional, folder.join(FILE))
    }

    /// Reads the record of the run in `folder`.
    ///
    /// # Errors
    /// [`RecordError`] where there is none of this format.
    pub fn read(folder: &Path) -> Result<Self, RecordError> {
        read(folder)
    }

    /// When the run in `folder` started, without looking at the rest of its record.
    ///
    /// # Errors
    /// [`RecordError`] where there is no record of this format.
    fn read_started(folder: &Path) -> Result<String, RecordError> {
        #[derive(Deserialize)]
        struct Started {
            started: String,
        }
        read(folder).map(|Started { started }| started)
    }

    /// Runs in folders beside `folder`, the run's own, that started before it or in the same second: the newest first, twenty at most, each with its folder's name. A folder whose record cannot be read
    /// is left out and shown to `left_out`.
    pub fn earlier(&self, folder: &Path, left_out: impl Fn(&Path, &RecordError)) -> Vec<(String, Self)> {
        let Ok(own) = fs::canonicalize(folder) else { return Vec::new() };
        let Some(entries) = own.parent().and_then(|parent| fs::read_dir(parent).ok()) else { return Vec::new() };
        let mut found: Vec<(String, PathBuf)> = entries
            .filter_map(|entry| entry.ok().map(|entry| entry.path()))
            .filter(|path| *path != own && path.join(FILE).is_file())
            .filter_map(|path| {
                let started = Self::read_started(&path).inspect_err(|error| left_out(&path, error)).ok()?;
                // RFC 3339 in UTC: the order of the texts is that of time. Short runs follow each other within a second.
                (started <= self.started).then_some((started, path))
            })
            .collect();
        found.sort_by(|a, b| b.cmp(a));
        found.truncate(NEWEST);
        let read = |(_, path): (String, PathBuf)| {
            let record = Self::read(&path).inspect_err(|error| left_out(&path, error)).ok()?;
            Some((path.file_name()?.to_string_lossy().into_owned(), record))
        };
        found.into_iter().filter_map(read).collect()
    }
}

fn read<T: DeserializeOwned>(folder: &Path) -> Result<T, RecordError> {
    #[derive(Deserialize)]
    struct Head {
        format: u32,
    }
    let path = folder.join(FILE);
    let shown = path.display().to_string();
    let text = fs::read_to_string(&path).map_err(|source| RecordError::Io { path: shown.clone(), source })?;
    let content = |source| RecordError::Content { path: shown.clone(), source };
    let head: Head = serde_json::from_str(&text).map_err(content)?;
    if head.format != FORMAT {
        return Err(RecordError::Format { path: shown, found: head.format });
    }
    serde_json::from_str(&text).map_err(content)
}
