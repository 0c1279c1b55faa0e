//! Defines why an exploration ends early.

use platebench_rig::{ConnectError, RigError};
use platebench_scenario::Diagnostic;
use platebench_trace::FileError;

#[derive(Debug, thiserror::Error)]
pub enum ExploreError {
    #[error(transparent)]
    Report(#[from] platebench_report::ReportError),
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// The controller does not answer, or rejects a configuration of the envelope.
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error("the controller does not announce the law {0}, expected --law with one of its laws")]
    LawNotAnnounced(&'static str),
    #[error("{0} has no declared properties, expected dq-pi, dq-pi-fixed or deadbeat")]
    LawWithoutProperties(&'static str),
    #[error("internal error: the bench generated an invalid scenario; report this message with the seed: {0}")]
    Generated(Box<Diagnostic>),
    #[error("internal error: the bench generated no scene; report this message with the seed: {0}")]
    Strategy(String),
    #[error(transparent)]
    File(#[from] FileError),
    /// The controller was lost in several scenes in a row.
    #[error("the controller was lost in {0} scenes in a row")]
    Lost(u32),
    #[error("the exploration was cancelled")]
    Cancelled,
    /// A worker ended early.
    #[error("internal error: a worker thread ended early; please report it")]
    Internal,
}
