//! Defines how a run asks its operator, the person at the plate or at the terminal.

use platebench_plate::Time;
use platebench_rig::CancelToken;

#[derive(Debug, Clone, Copy)]
pub struct Question<'a> {
    pub text: &'a str,
    pub kind: QuestionKind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QuestionKind {
    /// Asks for an action. The operator answers `yes` after it.
    Action,
    Confirm,
    Text,
    Number,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    Terminal(String),
    /// An option on the command line gave this answer in advance.
    CommandLine(String),
    /// No operator is present, none answered in time, or the question was cancelled.
    Absent,
}

impl Answer {
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Terminal(text) | Self::CommandLine(text) => Some(text),
            Self::Absent => None,
        }
    }

    pub fn is_yes(&self) -> bool {
        self.text() == Some("yes")
    }
}

/// Only [`Operator::ask`] may wait, because the trial continues during the other calls.
pub trait Operator: Sync {
    /// Waits for the answer until `cancel` is cancelled, or for a bounded time.
    fn ask(&self, question: Question<'_>, cancel: &CancelToken) -> Answer;

    /// `seconds` is the time until the action. 0 means that the action is due now.
    fn announce(&self, _action: &str, _seconds: u32) {}

    fn show_force(&self, _now: Time, _demanded_n: f64, _measured_n: Option<f64>) {}

    fn trial_ended(&self) {}
}

/// Never answers, so expectations that need an operator become inconclusive.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoOperator;

impl Operator for NoOperator {
    fn ask(&self, _question: Question<'_>, _cancel: &CancelToken) -> Answer {
        Answer::Absent
    }
}
