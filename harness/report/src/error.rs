//! Why a report could not be written.

use std::io;
use std::path::{Path, PathBuf};

/// Why a report could not be written. A trace that is missing is no reason: the report says so where it would have
/// stood.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The record cannot be said in JUnit's XML.
    #[error("{}: {source}", path.display())]
    Junit {
        /// The file.
        path: PathBuf,
        /// What the serialiser says.
        source: quick_junit::SerializeError,
    },
    /// A plot cannot be drawn.
    #[error("the plot of {title}: {source}")]
    Plot {
        /// What it shows.
        title: String,
        /// What the plotting library says.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

impl ReportError {
    /// Turns what the system says about `path` into an error.
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}
