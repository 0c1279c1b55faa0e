//! What is said on standard error while the screen is taken, by the log, by notes or by a controller program: kept, shown in the view, and said once more when the terminal is the user's again.

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

/// Lines that are kept; of more the oldest are forgotten and counted.
const MOST: usize = 500;
/// The longest line that is waited for.
const LONGEST: usize = 4096;
/// How often somebody looks whether the diversion is over.
const LOOK: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };

/// Lines in the order in which they were said.
#[derive(Debug, Default)]
pub(crate) struct Kept {
    lines: VecDeque<String>,
    forgotten: u64,
    /// The last one, until its end has come.
    open: Vec<u8>,
}

impl Kept {
    fn take(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            if byte == b'\n' || self.open.len() >= LONGEST {
                self.close();
            }
            if byte != b'\n' {
                self.open.push(byte);
            }
        }
    }

    fn close(&mut self) {
        let line = plain(&String::from_utf8_lossy(&std::mem::take(&mut self.open)));
        if line.is_empty() {
            return;
        }
        if self.lines.len() == MOST {
            self.lines.pop_front();
            self.forgotten += 1;
        }
        self.lines.push_back(line);
    }

    /// The last `count` lines.
    pub(crate) fn last(&self, count: usize) -> Vec<String> {
        self.lines.iter().skip(self.lines.len().saturating_sub(count)).cloned().collect()
    }
}

/// Text without what would move a cursor or change a colour.
fn plain(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        if character == '\u{1b}' && characters.as_str().starts_with('[') {
            // CSI, parameters and intermediates, one final byte from @ to ~.
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

/// Standard error as a pipe into this program, until this is dropped.
#[derive(Debug)]
pub(crate) struct Diverted {
    original: OwnedFd,
    kept: Arc<Mutex<Kept>>,
    over: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl Diverted {
    /// `None` where standard error is no terminal: it then goes on to wherever it goes.
    pub(crate) fn begin() -> io::Result<Option<Self>> {
        if !stderr().is_terminal() {
            return Ok(None);
        }
        let original = stderr().as_fd().try_clone_to_owned()?;
        let (reading, writing) = pipe_with(PipeFlags::CLOEXEC)?;
        let kept = Arc::new(Mutex::new(Kept::default()));
        let over = Arc::new(AtomicBool::new(false));
        let reader = {
            let (kept, over) = (Arc::clone(&kept), Arc::clone(&over));
            thread::Builder::new().name("stderr".to_owned()).spawn(move || read(reading.into(), &kept, &over))?
        };
        let diverted = Self { original, kept, over, reader: Some(reader) };
        dup2_stderr(&writing)?;
        Ok(Some(diverted))
    }

    /// What was said so far, for whoever shows it.
    pub(crate) fn kept(&self) -> Arc<Mutex<Kept>> {
        Arc::clone(&self.kept)
    }
}

/// Reads until the diversion is over and nothing is left. A program that still holds its end keeps nobody waiting.
fn read(mut pipe: File, kept: &Mutex<Kept>, over: &AtomicBool) {
    let mut bytes = [0; 4096];
    loop {
        let was_over = over.load(Ordering::Acquire);
        let ready = poll(&mut [PollFd::new(&pipe, PollFlags::IN)], Some(&LOOK)).is_ok_and(|ready| ready > 0);
        if ready {
            match pipe.read(&mut bytes) {
                Ok(count @ 1..) => {
                    let said = bytes.get(..count).unwrap_or_default();
                    kept.lock().unwrap_or_else(PoisonError::into_inner).take(said);
                }
                _ => return,
            }
        } else if was_over {
            return;
        }
    }
}

impl Drop for Diverted {
    fn drop(&mut self) {
        // The pipe's last end of this process goes with it.
        let _ = dup2_stderr(&self.original);
        self.over.store(true, Ordering::Release);
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.close();
        let mut terminal = stderr().lock();
        if kept.forgotten > 0 {
            let _ = writeln!(terminal, "({} earlier lines were not kept)", kept.forgotten);
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
    fn lines_are_kept_whole_and_without_what_moves_a_cursor() {
        let mut kept = Kept::default();
        kept.take(b"\r\x1b[Kwaiting for a con");
        assert!(kept.last(5).is_empty());
        kept.take(b"troller\r\n\x1b[1;31merror\x1b[0m: \xc2\xb5\tm\n\n");
        assert_eq!(kept.last(5), ["waiting for a controller", "error: µ m"]);
        assert_eq!(kept.last(1), ["error: µ m"]);
    }

    #[test]
    fn of_very_much_the_newest_is_kept_and_the_rest_counted() {
        let mut kept = Kept::default();
        (0..MOST + 7).for_each(|number| kept.take(format!("{number}\n").as_bytes()));
        assert_eq!((kept.lines.len(), kept.forgotten), (MOST, 7));
        assert_eq!(kept.last(1), [(MOST + 6).to_string()]);
        kept.take(&vec![b'x'; 3 * LONGEST]);
        assert!(kept.open.len() <= LONGEST);
    }

    #[test]
    fn a_sequence_that_never_ends_swallows_its_line_alone() {
        assert_eq!(plain("a\u{1b}[12;"), "a");
        assert_eq!(plain("a\u{1b}b\u{7}c"), "abc");
    }
}
