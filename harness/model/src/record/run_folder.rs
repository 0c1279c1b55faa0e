//! Creates, locks, reads and writes run folders.

use crate::input::{STANDARD_INPUT_NAME, STANDARD_STREAM};
use crate::record::reason::ExpectationRecord;
use crate::record::run_record::RigRecord;
use crate::record::run_record::{FORMAT, InputRecord, RunRecord};
use crate::scenario::{InputFile, Scenario};
use crate::trace::{AtPath, FileError, OutputFolder, open_regular_file, read_text_file, remove_empty_folders};
use jiff::Timestamp;
use jiff::tz::TimeZone;
use serde::de::{DeserializeOwned, Error, IgnoredAny, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs::{File, TryLockError};
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
use std::{fmt, fs, io};

const INPUTS: &str = "inputs";
const TRACES: &str = "traces";

#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error("{} already contains a run, expected a new folder", .0.display())]
    AlreadyUsed(PathBuf),
    #[error("{} already contains a campaign, expected a new folder", .0.display())]
    ContainsCampaign(PathBuf),
    #[error("{} is in use by another run, expected a new folder", .0.display())]
    InUse(PathBuf),
    #[error(transparent)]
    File(#[from] FileError),
}

#[derive(Debug, Clone)]
pub struct RunFolder {
    output: OutputFolder,
    started: Timestamp,
    sequence: u64,
    /// Parent folder that was created for this run.
    created_parent: Option<PathBuf>,
    /// Lock of the folder until the run ends, so that no other process uses it.
    _lock: Arc<FileLock>,
}

impl RunFolder {
    /// Creates a folder at `path` or below `runs/`. Fails if the folder contains a run.
    pub fn create(path: Option<&Path>) -> Result<Self, FolderError> {
        let started = Timestamp::now();
        let path = path.map_or_else(|| Path::new("runs").join(generate_name(started)), Path::to_owned);
        let created_parent = path.parent().filter(|parent| !parent.exists()).map(Path::to_owned);
        let output = OutputFolder::create(&path)?;
        let Some(lock) = FileLock::exclusive(&path)? else { return Err(FolderError::InUse(path)) };
        if [RECORD_FILE, JOURNAL_FILE].iter().any(|file| fs::symlink_metadata(path.join(file)).is_ok()) {
            return Err(FolderError::AlreadyUsed(path));
        }
        // A campaign has a report of the same name.
        if fs::symlink_metadata(path.join(CAMPAIGN_PLAN_FILE)).is_ok() {
            return Err(FolderError::ContainsCampaign(path));
        }
        let sequence = newest_in(&parent_of(&path)).map_or(0, |(order, _)| order.sequence) + 1;
        Ok(Self { output, started, sequence, created_parent, _lock: Arc::new(lock) })
    }

    /// Creates a folder below `runs` with the time as name.
    pub fn create_below(runs: &Path) -> Result<Self, FolderError> {
        Self::create(Some(&runs.join(generate_name(Timestamp::now()))))
    }

    pub fn path(&self) -> &Path {
        self.output.path()
    }

    /// Writes the files of the run.
    pub fn output(&self) -> &OutputFolder {
        &self.output
    }

    /// Removes the folder, and its parent if it was created for this run. Keeps folders with content.
    pub fn remove_if_empty(&self) -> bool {
        remove_empty_folders([&self.path().to_owned()].into_iter().chain(&self.created_parent))
    }

    /// One more than the largest number of the neighbouring runs.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Time of creation, as [`utc_timestamp`].
    pub fn started(&self) -> String {
        rfc3339(self.started)
    }

    pub fn create_trace_folder(&self, scenario: &Scenario) -> Result<(), FolderError> {
        self.output.create_folder(Path::new(TRACES).join(scenario.name()))?;
        Ok(())
    }

    /// Copies all input files and keeps their relative paths. Returns their records by scenario.
    pub fn store_inputs(&self, scenarios: &[&Scenario]) -> Result<Vec<Vec<InputRecord>>, FolderError> {
        // Paths in a scenario from standard input are relative to the current folder.
        let place = |input: &InputFile| match input.path.to_str() {
            Some(STANDARD_STREAM) => {
                fs::canonicalize(".").map(|folder| folder.join(STANDARD_INPUT_NAME)).at(&input.path)
            }
            _ => fs::canonicalize(&input.path).at(&input.path),
        };
        let all =
            scenarios.iter().flat_map(|scenario| &scenario.inputs).map(place).collect::<Result<BTreeSet<_>, _>>()?;
        let root = common_folder(&all);
        let store = |input: &InputFile| {
            let below = place(input)?;
            let relative = Path::new(INPUTS).join(below.strip_prefix(&root).unwrap_or(&below));
            let mut copy = self.output.create_file(&relative)?;
            copy.write_all(&input.bytes).at(&self.path().join(&relative))?;
            copy.commit_without_sync()?;
            Ok(InputRecord { file: with_slashes(&relative), sha256: sha256(&input.bytes) })
        };
        scenarios.iter().map(|scenario| scenario.inputs.iter().map(store).collect()).collect()
    }
}

/// Path relative to the run folder, with `/` as separator.
pub fn trace_path(scenario: &str, index: u32) -> String {
    format!("{TRACES}/{scenario}/{index:03}.csv")
}

/// Path of the frames of `defmt` that belong to a trace.
pub fn defmt_path(trace: &str) -> String {
    format!("{}.defmt", trace.strip_suffix(".csv").unwrap_or(trace))
}

/// Order of runs. Runs of 0.3 have no number and come first; their clock orders them.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct RunOrder {
    sequence: u64,
    /// RFC 3339 in UTC sorts as text.
    started: String,
}

/// Returns the folder of the newest run below `runs`; of equal ones, the one with the last name. Fails
/// if a record cannot be read, because it may be that of the newest run.
pub fn newest_run(runs: &Path) -> Result<Option<PathBuf>, RecordError> {
    let folders = fs::read_dir(runs).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
    let orders = folders.filter(|path| is_run_folder(path)).map(|path| Ok((read_order(&path)?, path)));
    Ok(orders.collect::<Result<Vec<_>, RecordError>>()?.into_iter().max().map(|(_, path)| path))
}

/// True if the folder contains the record of a run or its journal.
pub fn is_run_folder(path: &Path) -> bool {
    [RECORD_FILE, JOURNAL_FILE].iter().any(|file| path.join(file).is_file())
}

fn newest_in(runs: &Path) -> Option<(RunOrder, PathBuf)> {
    let folders = fs::read_dir(runs).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    folders.filter_map(|path| Some((read_order(&path).ok()?, path))).max()
}

/// The parent of a bare name is the working directory.
fn parent_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if parent.as_os_str().is_empty() => PathBuf::from("."),
        Some(parent) => parent.to_owned(),
        None => path.to_owned(),
    }
}

pub fn sha256(bytes: &[u8]) -> String {
    to_hex(&Sha256::digest(bytes))
}

/// SHA-256 of a file, hexadecimal. Fails if it is not a regular file.
pub fn sha256_of_file(path: &Path) -> io::Result<String> {
    let mut file = BufReader::new(open_regular_file(path, u64::MAX)?);
    let mut hash = Sha256::new();
    loop {
        let read = file.fill_buf()?;
        if read.is_empty() {
            return Ok(to_hex(&hash.finalize()));
        }
        hash.update(read);
        let length = read.len();
        file.consume(length);
    }
}

pub fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Present time, UTC, RFC 3339 to the second.
pub fn utc_timestamp() -> String {
    rfc3339(Timestamp::now())
}

fn rfc3339(time: Timestamp) -> String {
    time.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// The suffix is the part of the second, so that the order of the names is that of the runs. Its
/// step is 2⁶ ns.
fn generate_name(now: Timestamp) -> String {
    let time = now.to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ");
    format!("{time}-{:06x}", now.subsec_nanosecond() >> 6)
}

fn common_folder(files: &BTreeSet<PathBuf>) -> PathBuf {
    let mut folders = files.iter().filter_map(|file| file.parent());
    let Some(first) = folders.next() else { return PathBuf::new() };
    let mut common: Vec<Component<'_>> = first.components().collect();
    for folder in folders {
        let shared = common.iter().zip(folder.components()).take_while(|(a, b)| **a == *b).count();
        common.truncate(shared);
    }
    common.into_iter().collect()
}

fn with_slashes(path: &Path) -> String {
    path.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}

pub const RECORD_FILE: &str = "run.json";
/// One sealed line per trial.
pub const JOURNAL_FILE: &str = "trials.jsonl";
/// The plan in a campaign folder.
pub const CAMPAIGN_PLAN_FILE: &str = "plan.json";
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
    #[error("{}:{line}: {what}; the run was changed after it was played, restore its files", path.display())]
    Journal { path: PathBuf, line: u32, what: &'static str },
    #[error("{}: {what} `{found}`, expected a path below the run folder", path.display())]
    OutsidePath { path: PathBuf, what: &'static str, found: String },
}

impl RunRecord {
    /// Replaces the record in `folder` atomically.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        let mut file = OutputFolder::open(folder)?.create_file(RECORD_FILE)?;
        let mut writer = BufWriter::with_capacity(WRITE_BUFFER_BYTES, &mut file);
        serde_json::to_writer_pretty(&mut writer, self)?;
        writer.write_all(b"\n")?;
        writer.flush()?;
        drop(writer);
        // A sync at the start would delay the run.
        Ok(if self.complete { file.commit() } else { file.commit_without_sync() }?)
    }

    /// The record and, of a run that was killed, its sealed trials.
    pub fn read(folder: &Path) -> Result<Self, RecordError> {
        let mut record: Self = read(folder)?;
        record.read_journal(folder)?;
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
        let own_order = RunOrder { sequence: self.sequence, started: self.started.clone() };
        let mut earlier: Vec<(RunOrder, PathBuf)> = entries
            .filter_map(|entry| entry.ok().map(|entry| entry.path()))
            .filter(|path| *path != own && path.join(RECORD_FILE).exists())
            .filter_map(|path| {
                let order = read_order(&path).inspect_err(|error| skipped(&path, error)).ok()?;
                // Short runs of 0.3 may start in the same second.
                (order <= own_order).then_some((order, path))
            })
            .collect();
        earlier.sort_by(|a, b| b.cmp(a));
        earlier.truncate(MAX_EARLIER_RUNS);
        let read_named = |(_, path): (RunOrder, PathBuf)| {
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
    /// Stands before `started`.
    sequence: u64,
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
                Some("sequence") => self.sequence = map.next_value()?,
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

fn read_order(folder: &Path) -> Result<RunOrder, RecordError> {
    let path = folder.join(RECORD_FILE);
    let file = open_regular_file(&path, MAX_RECORD_BYTES).at(&path)?;
    let Head { sequence, started, .. } =
        Head::read(&path, &mut serde_json::Deserializer::from_reader(BufReader::new(file)))?;
    let missing = || RecordError::Content { path, source: serde_json::Error::missing_field("started") };
    Ok(RunOrder { sequence, started: started.ok_or_else(missing)? })
}

fn read<T: DeserializeOwned>(folder: &Path) -> Result<T, RecordError> {
    let path = folder.join(RECORD_FILE);
    let text = read_text_file(&path, MAX_RECORD_BYTES).at(&path)?;
    Head::read(&path, &mut serde_json::Deserializer::from_str(&text))?;
    serde_json::from_str(&text).map_err(|source| RecordError::Content { path, source })
}

#[derive(Debug)]
pub struct FileLock {
    /// The lock ends when the file is closed.
    _file: File,
}

impl FileLock {
    /// Locks the existing file or folder at `path` for one user. `None` if another user has it.
    pub fn exclusive(path: &Path) -> Result<Option<Self>, FileError> {
        let file = open(path)?;
        let result = file.try_lock();
        Ok(Self::after(file, &result))
    }

    /// Locks the existing file or folder at `path` for any number of users of this function. `None`
    /// if a user has it exclusively.
    pub fn shared(path: &Path) -> Result<Option<Self>, FileError> {
        let file = open(path)?;
        let result = file.try_lock_shared();
        Ok(Self::after(file, &result))
    }

    /// An error other than `WouldBlock` means a file system without locks.
    fn after(file: File, result: &Result<(), TryLockError>) -> Option<Self> {
        (!matches!(result, Err(TryLockError::WouldBlock))).then_some(Self { _file: file })
    }
}

/// Network file systems lock a file only for one that can write it. A folder can only be read.
#[cfg_attr(not(test), expect(clippy::disallowed_methods, reason = "opens an existing file, and writes nothing"))]
fn open(path: &Path) -> Result<File, FileError> {
    File::options().append(true).open(path).or_else(|_| File::open(path)).at(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_deepest_common_folder() {
        let of = |files: &[&str]| common_folder(&files.iter().map(PathBuf::from).collect());
        assert_eq!(of(&["/a/b/c.toml"]), Path::new("/a/b"));
        assert_eq!(of(&["/a/b/c.toml", "/a/bb/d.toml"]), Path::new("/a"));
        assert_eq!(of(&["/a/b/c.toml", "/a/b/x/d.toml"]), Path::new("/a/b"));
    }

    #[test]
    fn rejects_a_folder_with_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run");
        RunFolder::create(Some(&path)).unwrap();
        fs::write(path.join("run.json"), "{}").unwrap();
        assert!(matches!(RunFolder::create(Some(&path)), Err(FolderError::AlreadyUsed(_))));
        fs::rename(path.join("run.json"), path.join("plan.json")).unwrap();
        assert!(matches!(RunFolder::create(Some(&path)), Err(FolderError::ContainsCampaign(_))));
    }

    #[test]
    fn removes_an_empty_run_and_the_parent_that_it_created() {
        let folder = tempfile::tempdir().unwrap();
        let runs = folder.path().join("runs");
        let run = RunFolder::create_below(&runs).unwrap();
        let second = RunFolder::create_below(&runs).unwrap();
        assert!(run.remove_if_empty() && runs.exists());
        assert!(second.remove_if_empty() && runs.exists());
        fs::remove_dir(&runs).unwrap();
        assert!(RunFolder::create_below(&runs).unwrap().remove_if_empty() && !runs.exists());
    }

    #[test]
    fn names_have_the_order_of_the_runs() {
        let at = |nanos| generate_name(Timestamp::new(1_000_000_000, nanos).unwrap());
        assert_eq!(at(0), "20010909T014640Z-000000");
        assert_eq!(at(999_999_999), "20010909T014640Z-ee6b27");
        assert!(at(64) > at(0) && at(16_000_000) > at(15_000_000));
    }

    #[test]
    fn the_newest_run_of_a_second_has_the_last_name() {
        let runs = tempfile::tempdir().unwrap();
        for name in ["b", "c", "a"] {
            fs::create_dir(runs.path().join(name)).unwrap();
            let record = format!("{{\"format\": {FORMAT}, \"started\": \"2026-01-01T00:00:00Z\"}}");
            fs::write(runs.path().join(name).join(RECORD_FILE), record).unwrap();
        }
        assert_eq!(newest_run(runs.path()).unwrap(), Some(runs.path().join("c")));
    }

    #[test]
    fn hashes_with_sha256() {
        assert_eq!(sha256(b""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    }
}

#[cfg(test)]
mod file_lock_tests {
    use super::*;

    #[test]
    fn only_shared_users_lock_at_the_same_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let first = FileLock::shared(path).unwrap().unwrap();
        let second = FileLock::shared(path).unwrap().unwrap();
        assert!(FileLock::exclusive(path).unwrap().is_none());
        drop((first, second));
        let only = FileLock::exclusive(path).unwrap().unwrap();
        assert!(FileLock::shared(path).unwrap().is_none());
        assert!(FileLock::exclusive(path).unwrap().is_none());
        drop(only);
        assert!(FileLock::exclusive(path).unwrap().is_some());
    }
}
