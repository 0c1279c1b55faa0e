//! Why a run could not be exported.

use platebench_trace::TraceError;
use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};

/// Why a run could not be exported. What was whole before is there, nothing else.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A trace is not one.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The format's library refuses.
    #[error("{}: {source}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What the library says.
        source: Box<dyn Error + Send + Sync>,
    },
    /// A file of that name is there.
    #[error("{} is already there, expected a place where nothing would be written over; --out names another", .0.display())]
    FileExists(PathBuf),
    /// A scenario was asked for that the run does not have.
    #[error("the run has no scenario `{asked}`, expected one of {known}")]
    NoSuchScenario {
        /// What was asked for.
        asked: String,
        /// What there is.
        known: String,
    },
    /// The record names a file outside its folder.
    #[error("{}: `{named}` is not a file below the run folder", record.display())]
    OutsideRunFolder {
        /// The record.
        record: PathBuf,
        /// What it names.
        named: String,
    },
    /// The run started at a time that is none.
    #[error("{}: `started` is {text}, expected a time like 2026-03-02T09:30:00Z: {source}", record.display())]
    InvalidStartTime {
        /// The record.
        record: PathBuf,
        /// What it says.
        text: String,
        /// What is wrong with it.
        source: jiff::Error,
    },
    /// There is no whole trial.
    #[error("{}: no whole trial, expected at least one", .0.display())]
    NoCompleteTrial(PathBuf),
}

impl ExportError {
    /// Turns what the system says about `path` into an error.
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    /// Turns what a library says about `path` into an error.
    pub(crate) fn format<E: Error + Send + Sync + 'static>(path: &Path) -> impl Fn(E) -> Self {
        move |source| Self::Format { path: path.to_owned(), source: Box::new(source) }
    }
}
