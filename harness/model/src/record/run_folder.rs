//! Creates the run folder and stores the inputs in it.

use crate::record::file_lock::FileLock;
use crate::record::run_record::InputRecord;
use crate::scenario::{InputFile, Scenario};
use crate::trace::{AtPath, FileError, open_regular_file};
use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_plate::input::{STANDARD_INPUT_NAME, STANDARD_STREAM};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::io::{self, BufRead, BufReader};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

const INPUTS: &str = "inputs";
const TRACES: &str = "traces";

#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error("{} already contains a run, expected a new folder", .0.display())]
    AlreadyUsed(PathBuf),
    #[error("{} is in use by another run, expected a new folder", .0.display())]
    InUse(PathBuf),
    #[error(transparent)]
    File(#[from] FileError),
}

#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    started: Timestamp,
    /// Lock of the folder until the run ends, so that no other process uses it.
    _lock: Arc<FileLock>,
}

impl RunFolder {
    /// Creates a folder at `path` or below `runs/`. Fails if the folder contains a run.
    pub fn create(path: Option<&Path>) -> Result<Self, FolderError> {
        let started = Timestamp::now();
        let path = path.map_or_else(|| Path::new("runs").join(generate_name(started)), Path::to_owned);
        fs::create_dir_all(&path).at(&path)?;
        let Some(lock) = FileLock::exclusive(&path)? else { return Err(FolderError::InUse(path)) };
        if fs::symlink_metadata(path.join(crate::record::store::RECORD_FILE)).is_ok() {
            return Err(FolderError::AlreadyUsed(path));
        }
        Ok(Self { path, started, _lock: Arc::new(lock) })
    }

    /// Creates a folder below `runs`, with the time and a unique short id as name.
    pub fn create_below(runs: &Path) -> Result<Self, FolderError> {
        Self::create(Some(&runs.join(generate_name(Timestamp::now()))))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn remove_if_empty(&self) -> bool {
        fs::remove_dir(&self.path).is_ok()
    }

    /// Time of creation, as [`utc_timestamp`].
    pub fn started(&self) -> String {
        rfc3339(self.started)
    }

    pub fn create_trace_folder(&self, scenario: &Scenario) -> Result<(), FolderError> {
        let folder = self.path.join(TRACES).join(scenario.name());
        Ok(fs::create_dir_all(&folder).at(&folder)?)
    }

    /// Copies all input files and keeps their relative paths. Returns their records by scenario.
    pub fn store_inputs(&self, scenarios: &[Scenario]) -> Result<Vec<Vec<InputRecord>>, FolderError> {
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
            let target = self.path.join(&relative);
            if let Some(folder) = target.parent() {
                fs::create_dir_all(folder).at(folder)?;
            }
            fs::write(&target, &input.bytes).at(&target)?;
            Ok(InputRecord { file: with_slashes(&relative), sha256: sha256(&input.bytes) })
        };
        scenarios.iter().map(|scenario| scenario.inputs.iter().map(store).collect()).collect()
    }
}

/// Path relative to the run folder, with `/` as separator.
pub fn trace_path(scenario: &str, index: u32) -> String {
    format!("{TRACES}/{scenario}/{index:03}.csv")
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

fn generate_name(now: Timestamp) -> String {
    let time = now.to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ");
    let unique = sha256(format!("{} {}", now.as_nanosecond(), std::process::id()).as_bytes());
    format!("{time}-{}", unique.get(..6).unwrap_or_default())
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
    }

    #[test]
    fn hashes_with_sha256() {
        assert_eq!(sha256(b""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    }
}
