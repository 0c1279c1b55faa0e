//! Defines the errors of a session and its record.

use platebench_runner::{RejudgeError, RunError};
use platebench_scenario::Diagnostic;
use platebench_trust::TrustError;
use std::io;
use std::path::{Path, PathBuf};

/// Why a session cannot continue or a record cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AcceptError {
    /// The plan or one of its scenarios is invalid.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Plan(Vec<Diagnostic>),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// Something differs from the start of the session.
    #[error(
        "{what} is {now}, but the session was started with {then}; a record contains only one, expected a new --out \
         FOLDER"
    )]
    Changed {
        /// What differs.
        what: String,
        /// Its value at the start.
        then: String,
        /// Its value now.
        now: String,
    },
    /// The session has ended.
    #[error("{} contains a finished session, expected a new folder", .0.display())]
    Finished(PathBuf),
    /// The folder contains other files.
    #[error("{} contains other files than an acceptance session, expected a new folder", .0.display())]
    FolderNotEmpty(PathBuf),
    /// Another session writes to the folder.
    #[error("{} is being written by another session", .0.display())]
    InUse(PathBuf),
    /// No session.
    #[error("{}: contains no session, expected a folder that `platebench accept` wrote", .0.display())]
    NoSession(PathBuf),
    /// `session.json` is invalid.
    #[error("{}: {message}", path.display())]
    InvalidRecord {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A key is invalid.
    #[error("{}: not the expected ed25519 key in PEM: {message}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A scenario could not be played.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A stored run cannot be judged again.
    #[error(transparent)]
    Rejudge(#[from] RejudgeError),
    /// The test of the bench failed.
    #[error(transparent)]
    Trust(#[from] TrustError),
    /// A page cannot be written.
    #[error(transparent)]
    Report(#[from] platebench_report::ReportError),
    /// The operator answered no.
    #[error("stopped at \"{0}\": the answer was no; resume the session when the answer is yes")]
    AnsweredNo(String),
    /// No confirmation on a rig that may drive a plate.
    #[error(
        "stopped at \"{question}\": no answer, and {rig} may drive a plate; answer at a terminal, or confirm beforehand \
         with --yes"
    )]
    Unanswered {
        /// The question.
        question: String,
        /// The rig as named on the command line.
        rig: String,
    },
    /// The session was cancelled.
    #[error("the session was cancelled")]
    Cancelled,
}

impl AcceptError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self + use<> {
        let path = path.to_owned();
        |source| Self::Io { path, source }
    }
}
