//! Defines the errors of reports.

use platebench_trace::write_atomically;
use std::io;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: {source}", path.display())]
    Junit { path: PathBuf, source: quick_junit::SerializeError },
    #[error("the drawing of {title}: {source}")]
    Plot { title: String, source: Box<dyn std::error::Error + Send + Sync> },
}

impl ReportError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}

/// Replaces a file as a whole; writes into anything else, such as a pipe.
pub(crate) fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    let is_special = std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file());
    let written = if is_special { std::fs::write(path, text) } else { write_atomically(path, text.as_bytes()) };
    written.map_err(ReportError::io(path))
}
