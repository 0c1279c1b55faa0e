//! Defines why the view cannot open.

use std::io;

/// Largest terminal in cells: a frame is in memory twice, and a terminal may claim any size.
pub(crate) const MAX_CELLS: u32 = 1 << 20;

/// Reason why the view cannot open. The run continues without it.
#[derive(Debug, thiserror::Error)]
pub enum LiveViewError {
    /// Standard output is not a terminal.
    #[error("standard output is not a terminal")]
    NoTerminal,
    /// `TERM=dumb`: no cursor control.
    #[error("TERM=dumb: the terminal has no cursor control")]
    Dumb,
    /// The reported size is too large.
    #[error("the terminal reports {columns} x {rows} cells, expected at most {MAX_CELLS} in total")]
    Size {
        /// Columns.
        columns: u16,
        /// Rows.
        rows: u16,
    },
    /// Another process group owns the terminal.
    #[error("the program runs in the background of its terminal")]
    Background,
    /// A system call failed.
    #[error(transparent)]
    Io(#[from] io::Error),
}
