//! The terminal of the view: taken as a whole, and given back however the program ends.

use crate::view::NoView;
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

/// A terminal that takes nothing for this long is not waited for.
const PATIENCE: Timespec = Timespec { tv_sec: 0, tv_nsec: 300_000_000 };
/// A key that does nothing (`_POSIX_VDISABLE` on Linux).
const DISABLED: u8 = 0;

/// A terminal that shows the view until this is dropped.
#[derive(Debug)]
pub(crate) struct Screen {
    terminal: File,
    saved: Termios,
}

impl Screen {
    /// Takes the terminal on standard output.
    pub(crate) fn enter() -> Result<Self, NoView> {
        if !stdout().is_terminal() {
            return Err(NoView::NoTerminal);
        }
        if std::env::var_os("TERM").is_some_and(|name| name == "dumb") {
            return Err(NoView::Dumb);
        }
        let mut terminal = Self::writer()?;
        // Whoever is not in the foreground would be stopped as soon as it changed the terminal. One that is nobody's own has no foreground.
        if tcgetpgrp(&terminal).is_ok_and(|foreground| foreground != getpgrp()) {
            return Err(NoView::Background);
        }
        let saved = tcgetattr(&terminal).map_err(io::Error::from)?;
        tcsetattr(&terminal, OptionalActions::Now, &keyed(&saved)).map_err(io::Error::from)?;
        let entered = execute!(terminal, EnterAlternateScreen, Hide);
        // From here on dropping it gives the terminal back.
        let screen = Self { terminal, saved };
        entered?;
        Ok(screen)
    }

    /// A way to the terminal that shares no lock with whoever else writes to standard output.
    fn writer() -> io::Result<File> {
        Ok(File::from(stdout().as_fd().try_clone_to_owned()?))
    }

    /// As `writer`, for pictures; `gone` is set once the terminal takes none any more.
    pub(crate) fn pictures(gone: Arc<AtomicBool>) -> io::Result<Pictures> {
        Ok(Pictures { terminal: Self::writer()?, gone })
    }

    fn takes_bytes(&self) -> bool {
        let mut terminal = [PollFd::new(&self.terminal, PollFlags::OUT)];
        poll(&mut terminal, Some(&PATIENCE)).is_ok_and(|ready| ready > 0)
    }
}

/// A way to the terminal on which nothing fails: ratatui's terminal complains on standard error when it is dropped and cannot be written to, which panics where that is the same terminal.
#[derive(Debug)]
pub(crate) struct Pictures {
    terminal: File,
    gone: Arc<AtomicBool>,
}

impl Write for Pictures {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.gone.load(Ordering::Relaxed) {
            return Ok(bytes.len());
        }
        match self.terminal.write(bytes) {
            Ok(written @ 1..) => Ok(written),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => Err(error),
            Ok(0) | Err(_) => {
                self.gone.store(true, Ordering::Relaxed);
                Ok(bytes.len())
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Keys come one by one and are not shown, Ctrl-C still interrupts, and nothing stops the program or its output half-way.
fn keyed(saved: &Termios) -> Termios {
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
        // Where the terminal is gone there is nothing to give back.
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.saved);
        if self.takes_bytes() {
            let _ = execute!(self.terminal, LeaveAlternateScreen, Show);
        }
    }
}
