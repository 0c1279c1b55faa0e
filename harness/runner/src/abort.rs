//! Defines why a trial on the wall clock, or a replay, ended early.

use platebench_rig::RigError;

pub(crate) enum TrialAbort {
    Cancelled,
    Lost(RigError),
}

impl From<RigError> for TrialAbort {
    fn from(error: RigError) -> Self {
        Self::Lost(error)
    }
}
