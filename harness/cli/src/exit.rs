use platebench_model::record::{RunRecord, Verdict};
use platebench_report::format::sign;
use std::process::ExitCode;

/// Exit code of the program. If several codes apply, the first of this order counts: invalid,
/// unreachable, failed, inconclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exit {
    Passed,
    Failed,
    /// Wrong usage or invalid input.
    Invalid,
    Inconclusive,
    NothingToRun,
    /// The rig could not be reached or was lost.
    Unreachable,
    Signal(u8),
}

impl Exit {
    pub(crate) fn of_record(record: &RunRecord) -> Self {
        if record.scenarios.is_empty() && record.verdict != Verdict::Fail {
            return Self::NothingToRun;
        }
        let unsafe_end = record.verdict == Verdict::Inconclusive && record.safe_confirmed == Some(false);
        if record.has_lost_controller() || unsafe_end {
            return Self::Unreachable;
        }
        Self::of_verdict(record.verdict)
    }

    pub(crate) fn of_verdict(verdict: Verdict) -> Self {
        match verdict {
            Verdict::Pass => Self::Passed,
            Verdict::Fail => Self::Failed,
            Verdict::Inconclusive => Self::Inconclusive,
        }
    }

    /// Verdict, and the cause if the bench and not the controller decided it.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Passed => "pass",
            Self::Failed => "fail",
            Self::Inconclusive => "inconclusive",
            Self::NothingToRun => "inconclusive (nothing to run)",
            Self::Unreachable => "inconclusive (rig)",
            Self::Invalid | Self::Signal(_) => "error",
        }
    }

    /// The sign before the verdict in every text.
    fn sign(self) -> &'static str {
        sign(match self {
            Self::Passed => Verdict::Pass,
            Self::Failed => Verdict::Fail,
            _ => Verdict::Inconclusive,
        })
    }

    /// `verdict: ✗ fail: REASON`
    pub(crate) fn verdict_line(self, reason: &str) -> String {
        format!("verdict: {} {}: {reason}", self.sign(), self.word())
    }

    pub(crate) const fn code(self) -> u8 {
        match self {
            Self::Passed => 0,
            Self::Failed => 1,
            Self::Invalid => 2,
            Self::Inconclusive => 3,
            Self::NothingToRun => 4,
            Self::Unreachable => 5,
            Self::Signal(number) => 128 + number,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit.code())
    }
}
