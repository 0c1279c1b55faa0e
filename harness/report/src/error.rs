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

pub(crate) fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    Ok(write_atomically(path, text.as_bytes()).at(path)?)
}
