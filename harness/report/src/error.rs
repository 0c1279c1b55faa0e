//! Defines the errors of reports.

use platebench_model::trace::{AtPath, FileError, write_atomically};
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: {source}", path.display())]
    Junit { path: PathBuf, source: quick_junit::SerializeError },
}

/// Replaces a file atomically. Writes directly into anything else, such as a pipe.
pub(crate) fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    let is_special = std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file());
    let written = if is_special { std::fs::write(path, text) } else { write_atomically(path, text.as_bytes()) };
    Ok(written.at(path)?)
}
