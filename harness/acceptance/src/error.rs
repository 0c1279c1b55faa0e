//! Why a session cannot go on, or a record cannot be used.

use platebench_runner::{RejudgeError, RunError};
use platebench_scenario::Diagnostic;
use platebench_trust::TrustError;
use std::io;
use std::path::{Path, PathBuf};

/// Why a session cannot go on, or a record cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AcceptError {
    /// The plan, or a scenario of it, is wrong.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Plan(Vec<Diagnostic>),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The session was begun with something else.
    #[error(
        "{what} is {now}, but the session was begun with {then}: a record never mixes the two, expected a new --out FOLDER"
    )]
    Changed {
        /// What differs.
        what: String,
        /// What the session was begun with.
        then: String,
        /// What there is now.
        now: String,
    },
    /// The session has come to its end already.
    #[error("{} holds a finished session, expected a new folder", .0.display())]
    Finished(PathBuf),
    /// There is something else in the folder.
    #[error("{} holds something else than an acceptance session, expected a new folder", .0.display())]
    FolderNotEmpty(PathBuf),
    /// Somebody else is at it.
    #[error("{} is being written by another session", .0.display())]
    InUse(PathBuf),
    /// There is no session.
    #[error("{}: no session, expected a folder that `platebench accept` made", .0.display())]
    NoSession(PathBuf),
    /// `session.json` is not one.
    #[error("{}: {message}", path.display())]
    InvalidRecord {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
    /// A key is not one.
    #[error("{}: not the ed25519 key in PEM that is wanted: {message}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
    /// A scenario could not be played.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A run of the record cannot be judged.
    #[error(transparent)]
    Rejudge(#[from] RejudgeError),
    /// The trial of the bench itself could not be made.
    #[error(transparent)]
    Trust(#[from] TrustError),
    /// A page cannot be written.
    #[error(transparent)]
    Report(#[from] platebench_report::ReportError),
    /// The person said that something is not as it has to be.
    #[error("stopped at \"{0}\": the answer was no; the session can be resumed once that is as it has to be")]
    AnsweredNo(String),
    /// Nobody said that all is as it has to be, and a plate may be driven.
    #[error(
        "stopped at \"{question}\": nobody answered, and what is on {rig} may drive a plate; answer at a terminal, or say yes beforehand with --yes"
    )]
    Unanswered {
        /// What was asked.
        question: String,
        /// The rig as named on the command line.
        rig: String,
    },
    /// The session was ended from outside.
    #[error("the session was ended early")]
    Cancelled,
}

impl AcceptError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self + use<> {
        let path = path.to_owned();
        |source| Self::Io { path, source }
    }
}
