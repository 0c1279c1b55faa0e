//! Reads single keys from the terminal.

use crossterm::event::{Event, KeyCode, KeyEventKind, KeyModifiers, poll, read};
use std::io::{IsTerminal, stdin};
use std::time::Duration;

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
        if let Ok(Event::Key(key)) = read()
            && key.kind != KeyEventKind::Release
            && let KeyCode::Char(letter) = key.code
        {
            let is_interrupt = letter == 'c' && key.modifiers.contains(KeyModifiers::CONTROL);
            typed(if is_interrupt { INTERRUPT } else { letter });
        }
    }
}
