//! Defines the options of an emulated board and the errors of its start, and reads its image.

use super::image::{ImageError, read_elf};
use crate::debug_port::DebuggerError;
use crate::target_error::TargetError;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EmulatedOptions {
    /// Frequency of the crystal on PH0 and PH1; 0 for no crystal.
    pub crystal_hz: u64,
    /// If false, the firmware handles traps, panics and resets, as on a board.
    pub stop_at_traps: bool,
}

impl Default for EmulatedOptions {
    fn default() -> Self {
        Self { crystal_hz: 8_000_000, stop_at_traps: true }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum EmulatedError {
    #[error("{}: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error("not a firmware for the emulated board: {0}")]
    Image(#[from] ImageError),
    #[error(transparent)]
    Debugger(#[from] DebuggerError),
    #[error(transparent)]
    Target(#[from] TargetError),
}

pub(super) fn read_image(elf: &Path) -> Result<Vec<u8>, EmulatedError> {
    read_elf(elf).map_err(|error| EmulatedError::Read { path: elf.to_owned(), error })
}
