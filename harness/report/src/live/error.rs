//! Defines the errors of a view that cannot open.

use std::io;

/// Largest terminal in cells. A terminal may report any size, and memory holds two frames.
#[cfg(feature = "screen")]
pub(crate) const MAX_CELLS: u32 = 1 << 20;

#[derive(Debug, thiserror::Error)]
pub enum LiveViewError {
    #[cfg(not(feature = "screen"))]
    #[error("this bench was built without it; build it with the feature `live`")]
    NotBuilt,
    #[error("standard output is not a terminal")]
    NoTerminal,
    #[error("TERM=dumb: the terminal has no cursor control")]
    Dumb,
    #[cfg(feature = "screen")]
    #[error("the terminal reports {columns} x {rows} cells, expected at most {MAX_CELLS} in total")]
    Size { columns: u16, rows: u16 },
    #[error("platebench runs as a background job of the terminal; bring it to the foreground (fg)")]
    Background,
    #[error(transparent)]
    Io(#[from] io::Error),
}
