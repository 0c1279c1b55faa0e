//! Why there is no suite.

use platebench_rig::ConnectError;
use platebench_rig::spec::SpecError;
use platebench_scenario::Diagnostic;
use std::fmt::Write as _;
use std::path::PathBuf;

/// Why no test of a suite can be played. None of them is played then, whatever filter was given: a suite that is half there would be green for the wrong reason.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    /// The rig is not one.
    #[error("{0}")]
    Rig(SpecError),
    /// There is no such rig in this build, or its words make no command.
    #[error(transparent)]
    Connect(ConnectError),
    /// Scenarios that cannot be played, with every fault of every file.
    #[error("{}", render_all(.0))]
    Scenarios(Vec<Diagnostic>),
    /// There is no scenario.
    #[error("there is nothing to run below {}", .0.display())]
    NoScenarios(PathBuf),
}

impl SuiteError {
    /// How the test program ends, by the codes of `platebench run`: 2 for invalid input, 4 where there is nothing to run.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Rig(_) | Self::Connect(_) | Self::Scenarios(_) => 2,
            Self::NoScenarios(_) => 4,
        }
    }
}

fn render_all(faults: &[Diagnostic]) -> String {
    faults.iter().fold(String::new(), |mut text, fault| {
        // Writing into a String cannot fail.
        let _ = writeln!(text, "{}\n", fault.render(false));
        text
    })
}
