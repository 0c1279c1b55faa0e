//! Reads and writes `run.json`, and finds earlier runs in neighbouring folders.

use crate::record::expectation_record::ExpectationRecord;
use crate::record::rig_record::RigRecord;
use crate::record::run_record::{FORMAT, RunRecord};
use crate::trace::{AtPath, AtomicFile, FileError, open_regular_file, read_text_file};
use serde::de::{DeserializeOwned, Error, IgnoredAny, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::io::{self, BufReader, BufWriter, Write};
use std::path::{Component, Path, PathBuf};
use std::{fmt, fs};

pub const RECORD_FILE: &str = "run.json";
/// A record of 10⁶ trials has about 600 MB.
const MAX_RECORD_BYTES: u64 = 1 << 30;
const WRITE_BUFFER_BYTES: usize = 64 << 10;
const MAX_EARLIER_RUNS: usize = 20;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}:{}:{}: {source}", path.display(), source.line(), source.column())]
    Content { path: PathBuf, source: serde_json::Error },
    #[error("{}: the record has format {found}, expected {FORMAT}", path.display())]
    Format { path: PathBuf, found: u32 },
    #[error("{}: {what} `{found}`, expected a path below the run folder", path.display())]
    OutsidePath { path: PathBuf, what: &'static str, found: String },
}

impl RunRecord {
    /// Replaces the record in `folder` atomically.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        let mut file = AtomicFile::create(&folder.join(RECORD_FILE))?;
        let mut writer = BufWriter::with_capacity(WRITE_BUFFER_BYTES, &mut file);
        serde_json::to_writer_pretty(&mut writer, self)?;
        writer.write_all(b"\n")?;
        writer.flush()?;
        drop(writer);
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

    /// The first path that is absolute or contains `..`. Readers join paths to folders, so such a
    /// path would leave the run folder.
    fn outside_path(&self) -> Option<(&'static str, &str)> {
        let paths = self.scenarios.iter().flat_map(|scenario| {
            let inputs = scenario.inputs.iter().map(|input| ("input", input.file.as_str()));
            let traces = scenario.trials.iter().map(|trial| ("trace", trial.trace.as_str()));
            std::iter::once(("scenario", scenario.file.as_str())).chain(inputs).chain(traces)
        });
        let is_outside = |path: &str| Path::new(path).components().any(|part| !matches!(part, Component::Normal(_)));
        paths.into_iter().find(|(_, path)| is_outside(path))
    }

    /// Up to 20 earlier runs in neighbouring folders, with folder names, newest first. Calls
    /// `skipped` for each record that cannot be read.
    pub fn earlier_runs<T: DeserializeOwned>(
        &self,
        folder: &Path,
        skipped: impl Fn(&Path, &RecordError),
    ) -> Vec<(String, T)> {
        let Ok(own) = fs::canonicalize(folder) else { return Vec::new() };
        let Some(entries) = own.parent().and_then(|parent| fs::read_dir(parent).ok()) else { return Vec::new() };
        let mut earlier: Vec<(String, PathBuf)> = entries
            .filter_map(|entry| entry.ok().map(|entry| entry.path()))
            .filter(|path| *path != own && path.join(RECORD_FILE).exists())
            .filter_map(|path| {
                let started = read_started(&path).inspect_err(|error| skipped(&path, error)).ok()?;
                // RFC 3339 in UTC sorts as text. Short runs may start in the same second.
                (started <= self.started).then_some((started, path))
            })
            .collect();
        earlier.sort_by(|a, b| b.cmp(a));
        earlier.truncate(MAX_EARLIER_RUNS);
        let read_named = |(_, path): (String, PathBuf)| {
            let record = read(&path).inspect_err(|error| skipped(&path, error)).ok()?;
            Some((path.file_name()?.to_string_lossy().into_owned(), record))
        };
        earlier.into_iter().filter_map(read_named).collect()
    }
}

#[derive(Debug, Clone, Deserialize)]
pub struct RunSummary {
    pub started: String,
    pub rig: RigRecord,
    pub scenarios: Vec<ScenarioSummary>,
}

#[derive(Debug, Clone, Deserialize)]
pub struct ScenarioSummary {
    pub file: String,
    pub law: String,
    pub expectations: Vec<ExpectationRecord>,
}

/// Keys at the start of a record that decide whether the rest is read.
#[derive(Default)]
struct Head {
    format: Option<u32>,
    started: Option<String>,
}

impl<'de> Visitor<'de> for &mut Head {
    type Value = ();

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("the record of a run")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        while self.format.is_none() || self.started.is_none() {
            match map.next_key::<String>()?.as_deref() {
                Some("format") => self.format = Some(map.next_value()?),
                Some("started") => self.started = Some(map.next_value()?),
                Some(_) => _ = map.next_value::<IgnoredAny>()?,
                None => break,
            }
        }
        Ok(())
    }
}

impl Head {
    fn read<'de>(path: &Path, source: impl Deserializer<'de, Error = serde_json::Error>) -> Result<Self, RecordError> {
        let mut head = Self::default();
        let result = source.deserialize_map(&mut head);
        match head.format {
            Some(FORMAT) => Ok(head),
            Some(found) => Err(RecordError::Format { path: path.to_owned(), found }),
            None => {
                let source = result.err().unwrap_or_else(|| serde_json::Error::missing_field("format"));
                Err(RecordError::Content { path: path.to_owned(), source })
            }
        }
    }
}

fn read_started(folder: &Path) -> Result<String, RecordError> {
    let path = folder.join(RECORD_FILE);
    let file = open_regular_file(&path, MAX_RECORD_BYTES).at(&path)?;
    let head = Head::read(&path, &mut serde_json::Deserializer::from_reader(BufReader::new(file)))?;
    head.started.ok_or_else(|| RecordError::Content { path, source: serde_json::Error::missing_field("started") })
}

fn read<T: DeserializeOwned>(folder: &Path) -> Result<T, RecordError> {
    let path = folder.join(RECORD_FILE);
    let text = read_text_file(&path, MAX_RECORD_BYTES).at(&path)?;
    Head::read(&path, &mut serde_json::Deserializer::from_str(&text))?;
    serde_json::from_str(&text).map_err(|source| RecordError::Content { path, source })
}
