//! Defines the errors of a session and its record.

use platebench_engine::{RejudgeError, RunError};
use platebench_experiments::trust::TrustError;
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::FileError;
use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum AcceptError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Plan(Vec<Diagnostic>),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "{what} is {now}, but the session was started with {then}; restore it, or start a new session with another \
         --out FOLDER"
    )]
    Changed { what: String, then: String, now: String },
    #[error("{} contains a finished session, which cannot be changed; name a new folder", .0.display())]
    Finished(PathBuf),
    #[error("{} contains files that belong to no acceptance session; name a new folder", .0.display())]
    FolderNotEmpty(PathBuf),
    #[error("another session is writing {}; wait until it ends, or name another folder", .0.display())]
    InUse(PathBuf),
    #[error("{}: contains no session, expected a folder that `platebench acceptance run` wrote", .0.display())]
    NoSession(PathBuf),
    #[error("{}: {message}", path.display())]
    InvalidRecord { path: PathBuf, message: String },
    #[error("{}: not the expected ed25519 key in PEM: {message}", path.display())]
    Key { path: PathBuf, message: String },
    #[error(
        "{instrument}: its calibration is valid from {calibrated} to {due}, but not today; calibrate the instrument, \
         or waive this with --waive-calibration NAME, which the record states"
    )]
    InvalidCalibration { instrument: String, calibrated: String, due: String },
    #[error(
        "--waive-calibration {0}: the budget has no instrument with this name, expected the name of an [[instrument]]"
    )]
    UnknownInstrument(String),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Rejudge(#[from] RejudgeError),
    #[error(transparent)]
    Trust(#[from] TrustError),
    #[error(transparent)]
    Report(#[from] platebench_report::ReportError),
    #[error("stopped at \"{0}\": the answer was no; resume the session when the answer is yes")]
    AnsweredNo(String),
    #[error(
        "stopped at \"{question}\": no answer, and {rig} may drive a plate; answer at a terminal, or \
         confirm beforehand with --yes"
    )]
    Unanswered { question: String, rig: String },
    #[error("the session was cancelled")]
    Cancelled,
}
