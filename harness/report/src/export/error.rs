//! Defines the errors of an export.

use platebench_model::trace::{FileError, TraceError};
use std::error::Error;
use std::path::{Path, PathBuf};

/// After an error, files that were complete before it remain.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: {source}", path.display())]
    Format { path: PathBuf, source: Box<dyn Error + Send + Sync> },
    #[error("{} exists, expected a new file; name another folder with --out", .0.display())]
    FileExists(PathBuf),
    #[error("the run has no scenario `{requested}`, expected one of {known}")]
    NoSuchScenario { requested: String, known: String },
    #[error("{}: `{named}` is not a file below the run folder", record.display())]
    OutsideRunFolder { record: PathBuf, named: String },
    #[error("{}: `started` is {text}, expected a time like 2026-03-02T09:30:00Z: {source}", record.display())]
    InvalidStartTime { record: PathBuf, text: String, source: jiff::Error },
    #[error("{}: no complete trial, expected at least one", .0.display())]
    NoCompleteTrial(PathBuf),
}

impl ExportError {
    pub(crate) fn format<E: Error + Send + Sync + 'static>(path: &Path) -> impl Fn(E) -> Self {
        move |source| Self::Format { path: path.to_owned(), source: Box::new(source) }
    }
}
