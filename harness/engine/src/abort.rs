//! Defines why a replay, a trial in real time or a trial on a real plate ends early.

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
