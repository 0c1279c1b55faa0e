//! Defines the errors of an export.

use platebench_trace::TraceError;
use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};

/// Why a run could not be exported. Files that were complete before remain.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A trace cannot be read.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The library of a format rejects the data.
    #[error("{}: {source}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The library's error.
        source: Box<dyn Error + Send + Sync>,
    },
    /// A file exists.
    #[error("{} exists, expected a new file; name another folder with --out", .0.display())]
    FileExists(PathBuf),
    /// The run has no such scenario.
    #[error("the run has no scenario `{requested}`, expected one of {known}")]
    NoSuchScenario {
        /// The requested scenario.
        requested: String,
        /// The scenarios of the run.
        known: String,
    },
    /// The record names a file outside its folder.
    #[error("{}: `{named}` is not a file below the run folder", record.display())]
    OutsideRunFolder {
        /// The record.
        record: PathBuf,
        /// The path in the record.
        named: String,
    },
    /// The start time of the run is invalid.
    #[error("{}: `started` is {text}, expected a time like 2026-03-02T09:30:00Z: {source}", record.display())]
    InvalidStartTime {
        /// The record.
        record: PathBuf,
        /// The start time.
        text: String,
        /// The parser's error.
        source: jiff::Error,
    },
    /// No trial is complete.
    #[error("{}: no complete trial, expected at least one", .0.display())]
    NoCompleteTrial(PathBuf),
}

impl ExportError {
    /// Converts an error of the operating system.
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    /// Converts an error of a library.
    pub(crate) fn format<E: Error + Send + Sync + 'static>(path: &Path) -> impl Fn(E) -> Self {
        move |source| Self::Format { path: path.to_owned(), source: Box::new(source) }
    }
}
