//! Defines what reaches the view: the description of a run, and keys of the terminal.

use crossterm::event::{Event as TerminalEvent, KeyCode, KeyEventKind, KeyModifiers, poll, read};
use platebench_engine::RunPlan;
use std::io;
use std::io::{IsTerminal, stdin};
use std::sync::Arc;
use std::time::Duration;

#[derive(Debug, Clone)]
pub struct RunDescription {
    pub command: &'static str,
    pub key_help: &'static str,
    /// The view draws one of its parallel trials.
    pub plan: Arc<RunPlan>,
    /// False if the operator ends the trials.
    pub has_end: bool,
}

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

const KEY_POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Character for Ctrl-C if the terminal is raw. During a live view, Ctrl-C sends a signal instead.
pub const INTERRUPT: char = '\u{3}';

/// Calls `typed` for each key. Returns at once if standard input is not a terminal.
pub fn watch_keys(is_over: impl Fn() -> bool, mut typed: impl FnMut(char)) {
    if !stdin().is_terminal() {
        return;
    }
    while !is_over() {
        match poll(KEY_POLL_INTERVAL) {
            Ok(true) => {}
            Ok(false) => continue,
            Err(_) => return,
        }
        if let Ok(TerminalEvent::Key(key)) = read()
            && key.kind != KeyEventKind::Release
            && let KeyCode::Char(letter) = key.code
        {
            let is_interrupt = letter == 'c' && key.modifiers.contains(KeyModifiers::CONTROL);
            typed(if is_interrupt { INTERRUPT } else { letter });
        }
    }
}
