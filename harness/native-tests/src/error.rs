//! Defines the errors of an invalid suite.

use platebench_rig::ConnectError;
use platebench_rig::spec::SpecError;
use platebench_scenario::Diagnostic;
use std::fmt::Write as _;
use std::path::PathBuf;

/// Stops the whole suite for any filter, because a partial suite could pass by mistake.
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
    /// As for `platebench run`, 2 for invalid input and 4 without scenarios.
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
