//! Defines the options of an emulated board and why it may not start.

use super::image::ImageError;
use crate::target_error::TargetError;
use std::path::PathBuf;

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
    Target(#[from] TargetError),
}
