//! Ends a command: exit codes, errors with a report on standard error, and the verdict line.

use crate::options::OutputFormat;
use crate::stdio;
use platebench_document::format::sign;
use platebench_engine::{RejudgeError, RunError};
use platebench_model::quoted_path;
use platebench_model::record::{Assessment, RunOutcome, RunRecord, Verdict};
use platebench_model::scenario::Diagnostic;
use platebench_rig::{ConnectError, RigError};
use std::fmt::Display;
use std::path::Path;
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
        Assessment::of(record).outcome.into()
    }

    pub(crate) fn of_verdict(verdict: Verdict) -> Self {
        RunOutcome::of(verdict, false, true).into()
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

    /// The exit of a command with two results.
    pub(crate) fn worst(self, other: Self) -> Self {
        let severity = |exit| match exit {
            Self::Passed => 0,
            Self::NothingToRun => 1,
            Self::Inconclusive => 2,
            Self::Failed => 3,
            Self::Unreachable => 4,
            Self::Invalid => 5,
            Self::Signal(_) => 6,
        };
        if severity(other) > severity(self) { other } else { self }
    }

    /// The sign before the verdict in every text.
    pub(crate) fn sign(self) -> &'static str {
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

    /// True if `--quiet` hides the result, because it passed and people would read it.
    pub(crate) fn is_hidden(self, is_quiet: bool, format: OutputFormat) -> bool {
        is_quiet && self == Self::Passed && format == OutputFormat::Human
    }

    /// Ends a text on standard output with the verdict, if there is one. Beside JSON, which has its
    /// own verdict, it is on standard error.
    pub(crate) fn show_verdict(self, reason: &str, format: OutputFormat) {
        if matches!(self, Self::Invalid | Self::Signal(_)) {
            return;
        }
        let line = stdio::escape_commands(&self.verdict_line(reason));
        match format {
            OutputFormat::Human => stdio::show(&format!("{line}\n")),
            OutputFormat::Json => stdio::note(&line),
        }
    }

    /// Reports the reason of an exit code, after the verdict that the code means.
    pub(crate) fn show_reason(self, message: &str) {
        stdio::note(&format!("{}: {message}", self.word()));
    }

    /// Returns `Invalid` if standard output is incomplete.
    pub(crate) fn checked(self) -> Self {
        let Some(why) = stdio::write_error() else { return self };
        stdio::error(&format!("standard output is incomplete: {why}"));
        Self::Invalid
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

impl From<RunOutcome> for Exit {
    fn from(outcome: RunOutcome) -> Self {
        match outcome {
            RunOutcome::Passed => Self::Passed,
            RunOutcome::Failed => Self::Failed,
            RunOutcome::Inconclusive => Self::Inconclusive,
            RunOutcome::NothingToRun => Self::NothingToRun,
            RunOutcome::Unreachable => Self::Unreachable,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit.code())
    }
}

pub(crate) type CommandResult = Result<Exit, Failure>;

/// Reason why a command ended early. The program reports it after the command has returned.
#[derive(Debug, PartialEq)]
pub(crate) struct Failure {
    exit: Exit,
    report: Report,
}

#[derive(Debug, PartialEq)]
enum Report {
    /// The report is already on standard error.
    Done,
    Message(String),
    Problems(Vec<Diagnostic>),
}

impl Failure {
    pub(crate) fn new(exit: Exit, message: &impl Display) -> Self {
        Self { exit, report: Report::Message(message.to_string()) }
    }

    pub(crate) fn invalid(message: &impl Display) -> Self {
        Self::new(Exit::Invalid, message)
    }

    pub(crate) fn is_signal(&self) -> bool {
        matches!(self.exit, Exit::Signal(_))
    }

    pub(crate) fn report(self) -> Exit {
        match self.report {
            Report::Done => {}
            Report::Message(message) => self.exit.show_reason(&message),
            Report::Problems(problems) => problems.iter().for_each(stdio::diagnostic),
        }
        self.exit
    }
}

impl From<Exit> for Failure {
    fn from(exit: Exit) -> Self {
        Self { exit, report: Report::Done }
    }
}

impl From<Vec<Diagnostic>> for Failure {
    fn from(problems: Vec<Diagnostic>) -> Self {
        Self { exit: Exit::Invalid, report: Report::Problems(problems) }
    }
}

impl From<Diagnostic> for Failure {
    fn from(problem: Diagnostic) -> Self {
        vec![problem].into()
    }
}

impl From<Box<Diagnostic>> for Failure {
    fn from(problem: Box<Diagnostic>) -> Self {
        (*problem).into()
    }
}

impl From<ConnectError> for Failure {
    fn from(error: ConnectError) -> Self {
        Self::new(if error.is_invalid_input() { Exit::Invalid } else { Exit::Unreachable }, &error)
    }
}

impl From<RigError> for Failure {
    fn from(error: RigError) -> Self {
        // The firmware rejects a scenario or plate that it cannot control: an invalid input.
        let is_rejected = matches!(error, RigError::ConfigurationRejected(_));
        Self::new(if is_rejected { Exit::Invalid } else { Exit::Unreachable }, &error)
    }
}

impl From<RunError> for Failure {
    fn from(error: RunError) -> Self {
        match error {
            RunError::Scenario(problem) => problem.into(),
            RunError::Connect(error) => error.into(),
            RunError::Rig(error) => error.into(),
            RunError::DifferentController { .. }
            | RunError::DifferentProgram { .. }
            | RunError::Lost(_)
            | RunError::Rejected { .. } => Self::new(Exit::Unreachable, &error),
            RunError::Internal(_) | RunError::Cancelled => Self::new(Exit::Inconclusive, &error),
            // The firmware rejects a scenario or plate that it cannot control: an invalid input.
            RunError::Refused { .. }
            | RunError::Folder(_)
            | RunError::Trace(_)
            | RunError::NoTargetPacing(_)
            | RunError::NoRealPlate(_) => Self::invalid(&error),
        }
    }
}

impl From<RejudgeError> for Failure {
    fn from(error: RejudgeError) -> Self {
        match error {
            RejudgeError::Scenario(problem) => problem.into(),
            error => Self::invalid(&error),
        }
    }
}

pub(crate) trait OrInvalid<T> {
    fn or_invalid(self) -> Result<T, Failure>;

    /// Fails with a message that begins with `path`.
    fn or_invalid_at(self, path: &Path) -> Result<T, Failure>;
}

impl<T, E: Display> OrInvalid<T> for Result<T, E> {
    fn or_invalid(self) -> Result<T, Failure> {
        self.map_err(|error| Failure::invalid(&error))
    }

    fn or_invalid_at(self, path: &Path) -> Result<T, Failure> {
        self.map_err(|error| Failure::invalid(&format!("{}: {error}", quoted_path(path))))
    }
}
