//! Takes the terminal for the view and restores it, also after a panic. Captures standard error meanwhile and prints it
//! again afterwards.

use crate::live::events::LiveViewError;
use crossterm::cursor::{Hide, Show};
use crossterm::execute;
use crossterm::terminal::{EnterAlternateScreen, LeaveAlternateScreen};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::process::getpgrp;
use rustix::stdio::dup2_stderr;
use rustix::termios::{
    InputModes, LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, IsTerminal, Write, stderr, stdout};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

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

const MAX_LINES: usize = 500;
const MAX_LINE_BYTES: usize = 4096;
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };

#[derive(Debug, Default)]
pub(crate) struct CapturedLines {
    lines: VecDeque<String>,
    dropped_lines: u64,
    partial_line: Vec<u8>,
}

impl CapturedLines {
    fn push_bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            if byte == b'\n' || self.partial_line.len() >= MAX_LINE_BYTES {
                self.end_line();
            }
            if byte != b'\n' {
                self.partial_line.push(byte);
            }
        }
    }

    fn end_line(&mut self) {
        let line = strip_control_sequences(&String::from_utf8_lossy(&std::mem::take(&mut self.partial_line)));
        if line.is_empty() {
            return;
        }
        if self.lines.len() == MAX_LINES {
            self.lines.pop_front();
            self.dropped_lines += 1;
        }
        self.lines.push_back(line);
    }

    pub(crate) fn last_lines(&self, count: usize) -> Vec<String> {
        self.lines.iter().skip(self.lines.len().saturating_sub(count)).cloned().collect()
    }
}

fn strip_control_sequences(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        if character == '\u{1b}' && characters.as_str().starts_with('[') {
            // ESC [, then parameters and intermediates, then one final byte from @ to ~ (ECMA-48).
            characters.next();
            let _ = characters.by_ref().find(|last| ('@'..='~').contains(last));
        } else if character == '\t' {
            plain.push(' ');
        } else if !character.is_control() {
            plain.push(character);
        }
    }
    plain.trim_end().to_owned()
}

#[derive(Debug)]
pub(crate) struct StderrCapture {
    original: OwnedFd,
    captured_lines: Arc<Mutex<CapturedLines>>,
    is_stopped: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl StderrCapture {
    /// `None` if standard error is not a terminal. Standard error then stays unchanged.
    pub(crate) fn start() -> io::Result<Option<Self>> {
        if !stderr().is_terminal() {
            return Ok(None);
        }
        let original = stderr().as_fd().try_clone_to_owned()?;
        let (reading, writing) = pipe_with(PipeFlags::CLOEXEC)?;
        let kept = Arc::new(Mutex::new(CapturedLines::default()));
        let over = Arc::new(AtomicBool::new(false));
        let reader = {
            let (kept, over) = (Arc::clone(&kept), Arc::clone(&over));
            thread::Builder::new().name("stderr".to_owned()).spawn(move || read_pipe(reading.into(), &kept, &over))?
        };
        let capture = Self { original, captured_lines: kept, is_stopped: over, reader: Some(reader) };
        dup2_stderr(&writing)?;
        Ok(Some(capture))
    }

    pub(crate) fn lines(&self) -> Arc<Mutex<CapturedLines>> {
        Arc::clone(&self.captured_lines)
    }
}

/// Reads until the capture ends, even if a child process still holds the pipe open.
fn read_pipe(mut pipe: File, kept: &Mutex<CapturedLines>, over: &AtomicBool) {
    let mut bytes = [0; 4096];
    loop {
        let was_over = over.load(Ordering::Acquire);
        let ready = poll(&mut [PollFd::new(&pipe, PollFlags::IN)], Some(&POLL_INTERVAL)).is_ok_and(|ready| ready > 0);
        if ready {
            match io::Read::read(&mut pipe, &mut bytes) {
                Ok(count @ 1..) => {
                    let chunk = bytes.get(..count).unwrap_or_default();
                    kept.lock().unwrap_or_else(PoisonError::into_inner).push_bytes(chunk);
                }
                _ => return,
            }
        } else if was_over {
            return;
        }
    }
}

impl Drop for StderrCapture {
    fn drop(&mut self) {
        // This closes the last write end of the pipe in this process.
        let _ = dup2_stderr(&self.original);
        self.is_stopped.store(true, Ordering::Release);
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
        let mut kept = self.captured_lines.lock().unwrap_or_else(PoisonError::into_inner);
        kept.end_line();
        let mut terminal = stderr().lock();
        if kept.dropped_lines > 0 {
            let _ = writeln!(terminal, "({} earlier lines were not kept)", kept.dropped_lines);
        }
        for line in kept.lines.drain(..) {
            let _ = writeln!(terminal, "{line}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_whole_lines_without_cursor_sequences() {
        let mut kept = CapturedLines::default();
        kept.push_bytes(b"\r\x1b[Kwaiting for a con");
        assert!(kept.last_lines(5).is_empty());
        kept.push_bytes(b"troller\r\n\x1b[1;31merror\x1b[0m: \xc2\xb5\tm\n\n");
        assert_eq!(kept.last_lines(5), ["waiting for a controller", "error: µ m"]);
        assert_eq!(kept.last_lines(1), ["error: µ m"]);
    }

    #[test]
    fn keeps_the_newest_lines_and_counts_the_others() {
        let mut kept = CapturedLines::default();
        (0..MAX_LINES + 7).for_each(|number| kept.push_bytes(format!("{number}\n").as_bytes()));
        assert_eq!((kept.lines.len(), kept.dropped_lines), (MAX_LINES, 7));
        assert_eq!(kept.last_lines(1), [(MAX_LINES + 6).to_string()]);
        kept.push_bytes(&vec![b'x'; 3 * MAX_LINE_BYTES]);
        assert!(kept.partial_line.len() <= MAX_LINE_BYTES);
    }

    #[test]
    fn an_unterminated_sequence_removes_only_its_line() {
        assert_eq!(strip_control_sequences("a\u{1b}[12;"), "a");
        assert_eq!(strip_control_sequences("a\u{1b}b\u{7}c"), "abc");
    }
}
