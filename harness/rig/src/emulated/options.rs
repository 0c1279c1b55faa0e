//! Defines the options of an emulated board and why it may not start; reads its image.

use super::image::{ImageError, read_elf};
use crate::debug_port::DebuggerError;
use crate::target_error::TargetError;
use std::path::{Path, PathBuf};

/// From 5 % for both ends together, a UART misreads the tenth bit.
const BAUD_TOLERANCE_PERCENT: u64 = 2;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EmulatedOptions {
    /// Crystal on PH0 and PH1; 0: no crystal.
    pub crystal_hz: u64,
    /// `None`: any rate.
    pub baud: Option<u32>,
    /// False: the firmware handles traps, panics and resets, as on a board.
    pub stop_at_traps: bool,
}

impl Default for EmulatedOptions {
    fn default() -> Self {
        Self { crystal_hz: 8_000_000, baud: None, stop_at_traps: true }
    }
}

impl EmulatedOptions {
    pub(super) fn check_baud(&self, measured: u32) -> Result<(), TargetError> {
        let Some(expected) = self.baud else { return Ok(()) };
        if u64::from(measured.abs_diff(expected)) * 100 > u64::from(expected) * BAUD_TOLERANCE_PERCENT {
            return Err(TargetError::BaudMismatch { expected, measured });
        }
        Ok(())
    }
}

#[derive(Debug, thiserror::Error)]
pub enum EmulatedError {
    #[error("{}: {error}", path.display())]
    Read {
        /// Path of the ELF.
        path: PathBuf,
        error: std::io::Error,
    },
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
