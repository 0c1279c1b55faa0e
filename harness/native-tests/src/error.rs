//! Defines the errors of an invalid suite.

use platebench_model::scenario::Diagnostic;
use platebench_rig::{ConnectError, SpecError};
use std::fmt::Write as _;
use std::path::PathBuf;

/// Stops the whole suite, also with a filter, because a partial suite could pass by mistake.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    #[error("{0}")]
    Rig(SpecError),
    /// The rig is not part of this build, or its command is invalid.
    #[error(transparent)]
    Connect(ConnectError),
    #[error("{}", render_all(.0))]
    Scenarios(Vec<Diagnostic>),
    #[error("{}: no scenario was found below this folder", .0.display())]
    NoScenarios(PathBuf),
}

impl SuiteError {
    /// Equals the exit code of `platebench run`: 2 for invalid input, 4 if there is no scenario.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Rig(_) | Self::Connect(_) | Self::Scenarios(_) => 2,
            Self::NoScenarios(_) => 4,
        }
    }
}

fn render_all(faults: &[Diagnostic]) -> String {
    faults.iter().fold(String::new(), |mut text, fault| {
        let _ = writeln!(text, "{}\n", fault.render(false));
        text
    })
}
