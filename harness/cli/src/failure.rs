//! Ends a command early, with a report on standard error and an exit code.

use crate::exit::Exit;
use crate::stdio;
use platebench_engine::{RejudgeError, RunError};
use platebench_model::scenario::Diagnostic;
use platebench_rig::{ConnectError, RigError};
use std::fmt::Display;
use std::path::Path;

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
    Faults(Vec<Diagnostic>),
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
            Report::Message(message) => stdio::reason(self.exit, &message),
            Report::Faults(faults) => faults.iter().for_each(stdio::diagnostic),
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
    fn from(faults: Vec<Diagnostic>) -> Self {
        Self { exit: Exit::Invalid, report: Report::Faults(faults) }
    }
}

impl From<Diagnostic> for Failure {
    fn from(fault: Diagnostic) -> Self {
        vec![fault].into()
    }
}

impl From<Box<Diagnostic>> for Failure {
    fn from(fault: Box<Diagnostic>) -> Self {
        (*fault).into()
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
            RunError::Scenario(fault) => fault.into(),
            RunError::Connect(error) => error.into(),
            RunError::Rig(error) => error.into(),
            RunError::DifferentController { .. } | RunError::Lost(_) => Self::new(Exit::Unreachable, &error),
            RunError::Internal(_) | RunError::Cancelled => Self::new(Exit::Inconclusive, &error),
            RunError::Folder(_) | RunError::Trace(_) | RunError::NoTargetPacing(_) | RunError::NoRealPlate(_) => {
                Self::invalid(&error)
            }
        }
    }
}

impl From<RejudgeError> for Failure {
    fn from(error: RejudgeError) -> Self {
        match error {
            RejudgeError::Scenario(fault) => fault.into(),
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
        self.map_err(|error| Failure::invalid(&format!("{}: {error}", path.display())))
    }
}
