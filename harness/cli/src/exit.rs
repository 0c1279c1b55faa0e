//! Exit codes, all of them.

use platebench_rig::RigError;
use platebench_runner::RunError;
use platebench_verdict::{RunRecord, Verdict};
use std::process::ExitCode;

/// How the program ends. Where several apply: invalid, then unreachable, then failed, then inconclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exit {
    /// 0: everything passed.
    Passed,
    /// 1: something failed.
    Failed,
    /// 2: wrong usage or invalid input.
    Invalid,
    /// 3: nothing failed but something is inconclusive.
    Inconclusive,
    /// 4: there was nothing to run.
    Nothing,
    /// 5: the rig could not be reached or was lost.
    Unreachable,
    /// 128 + number of the signal that ended the run.
    Signal(u8),
}

impl Exit {
    /// How a run with this record ends.
    pub(crate) fn of_record(record: &RunRecord) -> Self {
        let unsafe_end = record.verdict == Verdict::Inconclusive && record.safe_confirmed == Some(false);
        if record.lost_a_controller() || unsafe_end {
            return Self::Unreachable;
        }
        Self::of_verdict(record.verdict)
    }

    /// How something with this verdict ends.
    pub(crate) fn of_verdict(verdict: Verdict) -> Self {
        match verdict {
            Verdict::Pass => Self::Passed,
            Verdict::Fail => Self::Failed,
            Verdict::Inconclusive => Self::Inconclusive,
        }
    }

    /// The number that the process ends with.
    pub(crate) const fn code(self) -> u8 {
        match self {
            Self::Passed => 0,
            Self::Failed => 1,
            Self::Invalid => 2,
            Self::Inconclusive => 3,
            Self::Nothing => 4,
            Self::Unreachable => 5,
            Self::Signal(number) => 128 + number,
        }
    }

    /// How a run without a record ends.
    pub(crate) fn of_error(error: &RunError) -> Self {
        match error {
            // Refused is what the firmware cannot do with the scenario or the plate.
            RunError::Scenario(_)
            | RunError::Folder(_)
            | RunError::Trace(_)
            | RunError::NoPace(_)
            | RunError::NoPlate(_)
            | RunError::Rig(RigError::Refused(_)) => Self::Invalid,
            RunError::Connect(error) if error.is_invalid_input() => Self::Invalid,
            RunError::Connect(_) | RunError::Rig(_) | RunError::OtherController { .. } => Self::Unreachable,
            RunError::Bench(_) | RunError::Cancelled => Self::Inconclusive,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit.code())
    }
}
