//! Captures standard error while the view owns the terminal and prints it again afterwards.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::stdio::dup2_stderr;
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, IsTerminal, Read, Write, stderr};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

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
            match pipe.read(&mut bytes) {
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
