//! Defines why a trial in real time, a trial on a real plate or a replay ended early.

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
