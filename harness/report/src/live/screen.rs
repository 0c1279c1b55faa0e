//! Takes the terminal for the view and restores it, also after a panic.

use crate::live::error::LiveViewError;
use crossterm::cursor::{Hide, Show};
use crossterm::execute;
use crossterm::terminal::{EnterAlternateScreen, LeaveAlternateScreen};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::getpgrp;
use rustix::termios::{
    InputModes, LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
};
use std::fs::File;
use std::io::{self, IsTerminal, Write, stdout};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Longest wait for a terminal that accepts no output.
const WRITE_TIMEOUT: Timespec = Timespec { tv_sec: 0, tv_nsec: 300_000_000 };
/// Value that disables a control character (`_POSIX_VDISABLE` on Linux).
const DISABLED: u8 = 0;

#[derive(Debug)]
pub(crate) struct Screen {
    terminal: File,
    saved: Termios,
}

impl Screen {
    pub(crate) fn enter() -> Result<Self, LiveViewError> {
        if !stdout().is_terminal() {
            return Err(LiveViewError::NoTerminal);
        }
        if std::env::var_os("TERM").is_some_and(|name| name == "dumb") {
            return Err(LiveViewError::Dumb);
        }
        let mut terminal = Self::open_terminal()?;
        // The kernel stops a background process (SIGTTOU) as soon as it changes the terminal.
        if tcgetpgrp(&terminal).is_ok_and(|foreground| foreground != getpgrp()) {
            return Err(LiveViewError::Background);
        }
        let saved = tcgetattr(&terminal).map_err(io::Error::from)?;
        tcsetattr(&terminal, OptionalActions::Now, &with_single_keys(&saved)).map_err(io::Error::from)?;
        let entered = execute!(terminal, EnterAlternateScreen, Hide);
        let screen = Self { terminal, saved };
        entered?;
        Ok(screen)
    }

    /// Opens a second handle that does not share the lock of standard output.
    fn open_terminal() -> io::Result<File> {
        Ok(File::from(stdout().as_fd().try_clone_to_owned()?))
    }

    /// The writer sets `gone` if the terminal accepts no more output.
    pub(crate) fn frame_writer(gone: Arc<AtomicBool>) -> io::Result<FrameWriter> {
        Ok(FrameWriter { terminal: Self::open_terminal()?, is_gone: gone })
    }

    fn is_writable(&self) -> bool {
        let mut terminal = [PollFd::new(&self.terminal, PollFlags::OUT)];
        poll(&mut terminal, Some(&WRITE_TIMEOUT)).is_ok_and(|ready| ready > 0)
    }
}

/// Never fails, because ratatui's `drop` would print the error to standard error, which panics if
/// the same terminal is gone.
#[derive(Debug)]
pub(crate) struct FrameWriter {
    terminal: File,
    is_gone: Arc<AtomicBool>,
}

impl Write for FrameWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.is_gone.load(Ordering::Relaxed) {
            return Ok(bytes.len());
        }
        match self.terminal.write(bytes) {
            Ok(written @ 1..) => Ok(written),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => Err(error),
            Ok(0) | Err(_) => {
                self.is_gone.store(true, Ordering::Relaxed);
                Ok(bytes.len())
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Delivers single keys without echo. Only Ctrl-C still sends a signal, and Ctrl-S does nothing.
fn with_single_keys(saved: &Termios) -> Termios {
    let mut modes = saved.clone();
    modes.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
    modes.input_modes.remove(InputModes::IXON);
    for (key, code) in [
        (SpecialCodeIndex::VSUSP, DISABLED),
        (SpecialCodeIndex::VQUIT, DISABLED),
        (SpecialCodeIndex::VMIN, 1),
        (SpecialCodeIndex::VTIME, 0),
    ] {
        modes.special_codes[key] = code;
    }
    modes
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.saved);
        if self.is_writable() {
            let _ = execute!(self.terminal, LeaveAlternateScreen, Show);
        }
    }
}
