//! Defines the errors of an exploration.

use platebench_engine::RunError;
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::FileError;
use platebench_rig::{ConnectError, RigError};

#[derive(Debug, thiserror::Error)]
pub enum ExploreError {
    #[error(transparent)]
    Report(#[from] platebench_report::ReportError),
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("the controller does not announce the law {0}, expected --law with one of its laws")]
    LawNotAnnounced(&'static str),
    #[error(
        "the law {0} cannot be explored, because it has no limits to check; expected --law dq-pi, dq-pi-fixed or \
         deadbeat"
    )]
    LawWithoutProperties(&'static str),
    #[error("internal error: the bench generated an invalid scenario ({0}); report this message and the seed")]
    Generated(Box<Diagnostic>),
    #[error("internal error: the bench generated no scene ({0}); report this message and the seed")]
    Strategy(String),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("the exploration was cancelled")]
    Cancelled,
}
