//! The run folder: inputs, traces, record.

use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_scenario::{Input, Scenario};
use platebench_verdict::record::InputRecord;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::path::{Component, Path, PathBuf};

const INPUTS: &str = "inputs";
const TRACES: &str = "traces";

/// Why a run folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// It is already there and holds a run.
    #[error("{} already holds a run, expected a new folder", .0.display())]
    Taken(PathBuf),
    /// It cannot be written or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// What cannot be written or read.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}

/// A folder that a run writes into.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    started: Timestamp,
}

fn io_at(path: &Path) -> impl FnOnce(io::Error) -> FolderError + use<> {
    let path = path.to_owned();
    |source| FolderError::Io { path, source }
}

impl RunFolder {
    /// A new folder at `path`, or below `runs/` under the time and a short id that nobody else has.
    ///
    /// # Errors
    /// [`FolderError`] where the folder holds a run already or cannot be made.
    pub fn create(path: Option<&Path>) -> Result<Self, FolderError> {
        let started = Timestamp::now();
        let path = path.map_or_else(|| Path::new("runs").join(new_name(started)), Path::to_owned);
        if path.join(platebench_verdict::record::FILE).exists() {
            return Err(FolderError::Taken(path));
        }
        fs::create_dir_all(&path).map_err(io_at(&path))?;
        Ok(Self { path, started })
    }

    /// A new folder below `runs`, under the time and a short id that nobody else has.
    ///
    /// # Errors
    /// [`FolderError::Io`] where it cannot be made.
    pub fn create_below(runs: &Path) -> Result<Self, FolderError> {
        Self::create(Some(&runs.join(new_name(Timestamp::now()))))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Takes the folder away again where nothing is in it; true where that is done.
    pub fn remove_if_empty(&self) -> bool {
        fs::remove_dir(&self.path).is_ok()
    }

    /// When it was made, UTC, RFC 3339 to the second.
    pub fn started(&self) -> String {
        self.started.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
    }

    /// Makes room for a scenario's traces.
    ///
    /// # Errors
    /// [`FolderError::Io`].
    pub fn prepare(&self, scenario: &Scenario) -> Result<(), FolderError> {
        let folder = self.path.join(TRACES).join(scenario.name());
        fs::create_dir_all(&folder).map_err(io_at(&folder))
    }

    /// Copies every input of every scenario, keeping how they lie to each other, and returns them by scenario.
    ///
    /// # Errors
    /// [`FolderError::Io`].
    pub fn store_inputs(&self, scenarios: &[Scenario]) -> Result<Vec<Vec<InputRecord>>, FolderError> {
        let place = |input: &Input| fs::canonicalize(&input.path).map_err(io_at(&input.path));
        let all =
            scenarios.iter().flat_map(|scenario| &scenario.inputs).map(place).collect::<Result<BTreeSet<_>, _>>()?;
        let root = common_folder(&all);
        let store = |input: &Input| {
            let below = place(input)?;
            let relative = Path::new(INPUTS).join(below.strip_prefix(&root).unwrap_or(&below));
            let target = self.path.join(&relative);
            if let Some(folder) = target.parent() {
                fs::create_dir_all(folder).map_err(io_at(folder))?;
            }
            fs::write(&target, &input.bytes).map_err(io_at(&target))?;
            Ok(InputRecord { file: slashed(&relative), sha256: sha256(&input.bytes) })
        };
        scenarios.iter().map(|scenario| scenario.inputs.iter().map(store).collect()).collect()
    }
}

/// Where the trace of a trial is filed, relative to the run folder, with `/`.
pub fn trace_file(scenario: &str, index: u32) -> String {
    format!("{TRACES}/{scenario}/{index:03}.csv")
}

/// SHA-256 in hexadecimal.
pub fn sha256(bytes: &[u8]) -> String {
    hexadecimal(&Sha256::digest(bytes))
}

/// SHA-256 of a file in hexadecimal, however long it is.
pub(crate) fn sha256_of(path: &Path) -> io::Result<String> {
    let mut file = BufReader::new(File::open(path)?);
    let mut hash = Sha256::new();
    loop {
        let read = file.fill_buf()?;
        if read.is_empty() {
            return Ok(hexadecimal(&hash.finalize()));
        }
        hash.update(read);
        let length = read.len();
        file.consume(length);
    }
}

/// Bytes in hexadecimal, two digits each.
pub fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing into a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn new_name(now: Timestamp) -> String {
    let time = now.to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ");
    let unique = sha256(format!("{} {}", now.as_nanosecond(), std::process::id()).as_bytes());
    format!("{time}-{}", unique.get(..6).unwrap_or_default())
}

/// The deepest folder that all files lie below.
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

fn slashed(path: &Path) -> String {
    path.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_share_the_deepest_folder() {
        let of = |files: &[&str]| common_folder(&files.iter().map(PathBuf::from).collect());
        assert_eq!(of(&["/a/b/c.toml"]), Path::new("/a/b"));
        assert_eq!(of(&["/a/b/c.toml", "/a/bb/d.toml"]), Path::new("/a"));
        assert_eq!(of(&["/a/b/c.toml", "/a/b/x/d.toml"]), Path::new("/a/b"));
    }

    #[test]
    fn a_folder_with_a_run_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run");
        RunFolder::create(Some(&path)).unwrap();
        fs::write(path.join("run.json"), "{}").unwrap();
        assert!(matches!(RunFolder::create(Some(&path)), Err(FolderError::Taken(_))));
    }

    #[test]
    fn the_hash_is_sha256() {
        assert_eq!(sha256(b""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    }
}
