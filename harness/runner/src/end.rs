//! How a trial on the wall's clock ends early, whoever paces it.

use platebench_rig::RigError;

/// Why a trial did not come to its end.
pub(crate) enum End {
    /// Somebody asked for it.
    GivenUp,
    /// The controller is no longer there.
    Lost(RigError),
}

impl From<RigError> for End {
    fn from(error: RigError) -> Self {
        Self::Lost(error)
    }
}
