//! Reads and writes `run.json`, and finds earlier runs in neighbouring folders.

use crate::run_record::{FORMAT, RunRecord};
use platebench_trace::{AtomicFile, read_text_file};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::fs;
use std::io::{self, Write};
use std::path::{Component, Path, PathBuf};

pub const RECORD_FILE: &str = "run.json";
/// A record of 10⁶ trials has some 600 MB.
const MAX_RECORD_BYTES: u64 = 1 << 30;
const MAX_EARLIER_RUNS: usize = 20;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error("{}: {source}", path.display())]
    Io {
        /// Run folder's record.
        path: PathBuf,
        source: io::Error,
    },
    #[error("{}:{}:{}: {source}", path.display(), source.line(), source.column())]
    Content {
        path: PathBuf,
        /// The parser's error.
        source: serde_json::Error,
    },
    #[error("{}: format {found}, expected {FORMAT}", path.display())]
    Format {
        path: PathBuf,
        /// Version in the file.
        found: u32,
    },
    #[error("{}: {what} `{found}`, expected a path below the run folder", path.display())]
    OutsidePath {
        path: PathBuf,
        /// Which path.
        what: &'static str,
        found: String,
    },
}

impl RunRecord {
    /// Replaces the record in `folder` atomically.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        let mut file = AtomicFile::create(&folder.join(RECORD_FILE))?;
        file.write_all(text.as_bytes())?;
        // A sync after every scenario would delay the run.
        if self.complete { file.commit() } else { file.commit_without_sync() }
    }

    pub fn read(folder: &Path) -> Result<Self, RecordError> {
        let record: Self = read(folder)?;
        match record.outside_path() {
            None => Ok(record),
            Some((what, found)) => {
                let (path, found) = (folder.join(RECORD_FILE), found.to_owned());
                Err(RecordError::OutsidePath { path, what, found })
            }
        }
    }

    /// The first path that is absolute or contains `..`; readers join these paths to folders.
    fn outside_path(&self) -> Option<(&'static str, &str)> {
        let paths = self.scenarios.iter().flat_map(|scenario| {
            let inputs = scenario.inputs.iter().map(|input| ("input", input.file.as_str()));
            let traces = scenario.trials.iter().map(|trial| ("trace", trial.trace.as_str()));
            std::iter::once(("scenario", scenario.file.as_str())).chain(inputs).chain(traces)
        });
        let is_outside = |path: &str| Path::new(path).components().any(|part| !matches!(part, Component::Normal(_)));
        paths.into_iter().find(|(_, path)| is_outside(path))
    }

    /// Runs in neighbouring folders that started no later, newest first, at most 20, with folder.
    /// Unreadable records are passed to `skipped`.
    pub fn earlier_runs(&self, folder: &Path, skipped: impl Fn(&Path, &RecordError)) -> Vec<(String, Self)> {
        #[derive(Deserialize)]
        struct Started {
            started: String,
        }
        let Ok(own) = fs::canonicalize(folder) else { return Vec::new() };
        let Some(entries) = own.parent().and_then(|parent| fs::read_dir(parent).ok()) else { return Vec::new() };
        let mut earlier: Vec<(String, PathBuf)> = entries
            .filter_map(|entry| entry.ok().map(|entry| entry.path()))
            .filter(|path| *path != own && path.join(RECORD_FILE).exists())
            .filter_map(|path| {
                let Started { started } = read(&path).inspect_err(|error| skipped(&path, error)).ok()?;
                // RFC 3339 in UTC sorts as text. Short runs follow each other within a second.
                (started <= self.started).then_some((started, path))
            })
            .collect();
        earlier.sort_by(|a, b| b.cmp(a));
        earlier.truncate(MAX_EARLIER_RUNS);
        let read_named = |(_, path): (String, PathBuf)| {
            let record = Self::read(&path).inspect_err(|error| skipped(&path, error)).ok()?;
            Some((path.file_name()?.to_string_lossy().into_owned(), record))
        };
        earlier.into_iter().filter_map(read_named).collect()
    }
}

fn read<T: DeserializeOwned>(folder: &Path) -> Result<T, RecordError> {
    #[derive(Deserialize)]
    struct Head {
        format: u32,
    }
    let path = folder.join(RECORD_FILE);
    let text =
        read_text_file(&path, MAX_RECORD_BYTES).map_err(|source| RecordError::Io { path: path.clone(), source })?;
    let content = |source| RecordError::Content { path: path.clone(), source };
    let head: Head = serde_json::from_str(&text).map_err(content)?;
    if head.format != FORMAT {
        return Err(RecordError::Format { path, found: head.format });
    }
    serde_json::from_str(&text).map_err(content)
}
