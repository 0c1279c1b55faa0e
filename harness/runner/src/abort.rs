//! Says why a trial on the wall clock ended early.

use platebench_rig::RigError;

/// Why a trial ended early.
pub(crate) enum TrialAbort {
    /// It was cancelled.
    Cancelled,
    /// The controller was lost.
    Lost(RigError),
}

impl From<RigError> for TrialAbort {
    fn from(error: RigError) -> Self {
        Self::Lost(error)
    }
}
