//! Asks the person at the plate or at the terminal.

use platebench_plate::Time;
use platebench_rig::CancelToken;

/// A question to the operator.
#[derive(Debug, Clone, Copy)]
pub struct Question<'a> {
    /// The question, or the action that is needed.
    pub text: &'a str,
    /// What is asked for.
    pub kind: QuestionKind,
}

/// What a question asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QuestionKind {
    /// An action at the plate: `yes` once it is done.
    Action,
    /// `yes` or `no`.
    Confirm,
    /// A line of text.
    Text,
}

/// The answer to a question.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// A person answered `yes`, `no` or a text.
    Terminal(String),
    /// An option of the command line answered `yes`.
    CommandLine(String),
    /// No operator is present, none answered in time, or the question was cancelled.
    Absent,
}

impl Answer {
    /// The answer's text; `None` without an answer.
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Terminal(text) | Self::CommandLine(text) => Some(text),
            Self::Absent => None,
        }
    }

    /// True if the answer is `yes`.
    pub fn is_yes(&self) -> bool {
        self.text() == Some("yes")
    }
}

/// The person at the plate. Only [`Operator::ask`] may wait.
pub trait Operator: Sync {
    /// Asks and waits for the answer until `cancel` or for a bounded time.
    fn ask(&self, question: Question<'_>, cancel: &CancelToken) -> Answer;

    /// Announces an action that is due in `seconds`; 0 means now.
    fn announce(&self, _action: &str, _seconds: u32) {}

    /// Shows the demanded force, N, and the measured one at this time of the trial.
    fn show_force(&self, _now: Time, _demanded_n: f64, _measured_n: Option<f64>) {}

    /// Ends the announcements of a trial.
    fn trial_ended(&self) {}
}

/// An operator who is absent: what needs a person stays inconclusive.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoOperator;

impl Operator for NoOperator {
    fn ask(&self, _question: Question<'_>, _cancel: &CancelToken) -> Answer {
        Answer::Absent
    }
}
