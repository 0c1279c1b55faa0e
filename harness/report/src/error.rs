//! Lists the errors of reports.

use platebench_trace::write_atomically;
use std::io;
use std::path::{Path, PathBuf};

/// The reason why a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The record cannot be written as XML.
    #[error("{}: {source}", path.display())]
    Junit {
        /// The file.
        path: PathBuf,
        /// The serialiser's error.
        source: quick_junit::SerializeError,
    },
    /// A drawing cannot be made.
    #[error("the drawing of {title}: {source}")]
    Plot {
        /// Its title.
        title: String,
        /// The plotting library's error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

impl ReportError {
    /// Adds the path to an error of the operating system.
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}

/// Replaces the file at `path` as a whole; anything else there, such as a pipe, is written to.
pub(crate) fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    let is_special = std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file());
    let written = if is_special { std::fs::write(path, text) } else { write_atomically(path, text.as_bytes()) };
    written.map_err(ReportError::io(path))
}
