//! Defines the errors that end an analysis.

use platebench_engine::RunError;
use platebench_model::scenario::Diagnostic;
use platebench_rig::{ConnectError, EmulatedError, RigError};

#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    #[error("the rig `{0}` does not run the firmware on the emulator, expected --rig emulated or --rig emulated:ELF")]
    NotEmulated(String),
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Emulated(#[from] EmulatedError),
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(
        "the unchanged firmware did not confirm 0 V, or commanded a drive afterwards; expected an answer to `safe`"
    )]
    NotSafe,
    #[error("{file}: fails with the unchanged firmware ({reason}); expected a suite that passes")]
    FailingScenario { file: String, reason: String },
    #[error("the firmware can play none of the scenarios:\n  {}", .0.join("\n  "))]
    NothingApplicable(Vec<String>),
    #[error("the ELF has no function symbols in flash, expected an image that is not stripped")]
    NoFunctions,
    #[error("no function or file matches `{0}`")]
    NoMatch(String),
    #[error("the disassembler failed: {0}")]
    Disassembler(String),
    #[error("cancelled")]
    Cancelled,
}

impl AnalysisError {
    /// False if the run was cancelled or the bench has a defect.
    pub fn is_invalid_input(&self) -> bool {
        !matches!(self, Self::Cancelled | Self::Run(RunError::Cancelled) | Self::Disassembler(_))
    }
}
