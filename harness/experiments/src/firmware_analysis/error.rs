//! Defines the errors that end an analysis.

use platebench_engine::RunError;
use platebench_model::scenario::Diagnostic;
use platebench_rig::{ConnectError, EmulatedError};

#[derive(Debug, thiserror::Error)]
pub enum FirmwareAnalysisError {
    #[error("the rig `{0}` does not run the firmware on the emulator, expected --rig emulated or --rig emulated:ELF")]
    NotEmulated(String),
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Emulated(#[from] EmulatedError),
    #[error(transparent)]
    Connect(#[from] ConnectError),
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
    #[error(
        "{} of {total} functions in flash have no line table: {}; expected debug information of all of the firmware: \
         {}, or select files that have it by --only",
        .functions.len(), first_names(.functions), if *.compressed {
            "link with -gz=none, because compressed sections are not read"
        } else {
            "compile with -g, and do not strip the ELF (no -s, no --strip-debug)"
        }
    )]
    NoLines { functions: Vec<String>, total: usize, compressed: bool },
    #[error("no function or file matches `{0}`")]
    NoMatch(String),
    #[error("the disassembler failed: {0}")]
    Disassembler(String),
}

/// Largest number of functions that a message names.
const MAX_NAMES: usize = 5;

fn first_names(functions: &[String]) -> String {
    let names: Vec<&str> = functions.iter().take(MAX_NAMES).map(String::as_str).collect();
    names.join(", ") + if functions.len() > MAX_NAMES { ", …" } else { "" }
}

impl FirmwareAnalysisError {
    /// False if the run was cancelled or the bench has a defect.
    pub fn is_invalid_input(&self) -> bool {
        !matches!(self, Self::Run(RunError::Cancelled) | Self::Disassembler(_))
    }
}
