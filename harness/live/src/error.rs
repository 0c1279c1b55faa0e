//! Defines why the view cannot open.

use std::io;

/// Largest terminal in cells: a frame is in memory twice, and a terminal may claim any size.
pub(crate) const MAX_CELLS: u32 = 1 << 20;

/// Reason why the view cannot open. The run continues without it.
#[derive(Debug, thiserror::Error)]
pub enum LiveViewError {
    #[error("standard output is not a terminal")]
    NoTerminal,
    #[error("TERM=dumb: the terminal has no cursor control")]
    Dumb,
    #[error("the terminal reports {columns} x {rows} cells, expected at most {MAX_CELLS} in total")]
    Size {
        columns: u16,
        /// In cells.
        rows: u16,
    },
    #[error("the program runs in the background of its terminal")]
    Background,
    #[error(transparent)]
    Io(#[from] io::Error),
}
