//! Relays the output of a program to the bench's standard error, line by line and escaped, because
//! a program of the user must not act on the terminal or look like a message of the bench.

use crate::tty::poll_until;
use platebench_model::printable::printable;
use rustix::event::PollFlags;
use rustix::fd::OwnedFd;
use std::io::{self, PipeReader, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// A longer line is printed as several lines.
const MAX_LINE_BYTES: usize = 1_000;
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Longest wait for the last lines of a program that has ended. The bench's standard error may be
/// a pipe that is not read.
const LAST_LINES_TIMEOUT: Duration = Duration::from_millis(200);

/// Dropping the value prints what the program has written before, then ends the relay.
#[derive(Debug)]
pub(super) struct OutputRelay {
    is_stopped: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl OutputRelay {
    /// `program` precedes each line.
    pub(super) fn start(program: &str, output: PipeReader) -> io::Result<Self> {
        let is_stopped = Arc::new(AtomicBool::new(false));
        let stop = Arc::clone(&is_stopped);
        let mut lines = Lines::new(program);
        let relay = move || relay(&output.into(), &stop, |bytes| print(&lines.add(bytes)));
        let thread = thread::Builder::new().name("output".to_owned()).spawn(relay)?;
        Ok(Self { is_stopped, thread })
    }
}

impl Drop for OutputRelay {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        let deadline = Instant::now() + LAST_LINES_TIMEOUT;
        // Not joined, because a write to standard error may block.
        while !self.thread.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Reads until the end of the output. After `stop`, another process may keep the pipe open, so
/// that silence ends the relay too. The last call of `consume` has no bytes.
fn relay(output: &OwnedFd, stop: &AtomicBool, mut consume: impl FnMut(&[u8])) {
    let mut chunk = [0; 4096];
    loop {
        let is_last = stop.load(Ordering::Relaxed);
        match poll_until(output, PollFlags::IN, Instant::now() + POLL_INTERVAL) {
            Ok(true) => {}
            Ok(false) if is_last => break,
            Ok(false) => continue,
            Err(_) => break,
        }
        match rustix::io::read(output, &mut chunk) {
            Ok(0) => break,
            Ok(count) => consume(chunk.get(..count).unwrap_or_default()),
            Err(rustix::io::Errno::INTR) => {}
            Err(_) => break,
        }
    }
    consume(&[]);
}

fn print(text: &str) {
    // A closed standard error must not end the relay, because the program would block.
    let _ = io::stderr().write_all(text.as_bytes());
}

#[derive(Debug)]
struct Lines {
    prefix: String,
    unfinished: Vec<u8>,
}

impl Lines {
    fn new(program: &str) -> Self {
        let name = program.rsplit('/').next().unwrap_or(program);
        Self { prefix: format!("{}: ", printable(name)), unfinished: Vec::new() }
    }

    /// Returns the complete lines, each with the prefix and a line feed. No bytes end the last one.
    fn add(&mut self, bytes: &[u8]) -> String {
        let mut lines = String::new();
        if bytes.is_empty() && !self.unfinished.is_empty() {
            self.finish_line(&mut lines);
        }
        for &byte in bytes {
            match byte {
                b'\n' => self.finish_line(&mut lines),
                _ => self.unfinished.push(byte),
            }
            if self.unfinished.len() == MAX_LINE_BYTES {
                self.finish_line(&mut lines);
            }
        }
        lines
    }

    fn finish_line(&mut self, lines: &mut String) {
        let line = String::from_utf8_lossy(&self.unfinished);
        let line = line.strip_suffix('\r').unwrap_or(&line).replace('\t', " ");
        lines.push_str(&self.prefix);
        lines.push_str(&printable(&line));
        lines.push('\n');
        self.unfinished.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::pipe;
    use std::sync::mpsc::channel;

    #[test]
    fn each_line_has_a_prefix_and_no_control_character() {
        let mut lines = Lines::new("/usr/bin/co\u{7}ntroller");
        assert_eq!(lines.add(b"one\ntw"), "co\\u{7}ntroller: one\n");
        let rest = "o \u{1b}[2J\u{202e}µ\ta\r\n\n";
        let expected = "co\\u{7}ntroller: two \\u{1b}[2J\\u{202e}µ a\nco\\u{7}ntroller: \n";
        assert_eq!(lines.add(rest.as_bytes()), expected);
        assert_eq!(lines.add(b"end \xff"), "");
        assert_eq!(lines.add(b""), "co\\u{7}ntroller: end \u{fffd}\n");
        assert_eq!(lines.add(b""), "");
    }

    #[test]
    fn a_long_line_is_split() {
        let mut lines = Lines::new("p");
        let whole = "x".repeat(MAX_LINE_BYTES);
        assert_eq!(lines.add(&whole.as_bytes()[1..]), "");
        assert_eq!(lines.add(b"xy\n"), format!("p: {whole}\np: y\n"));
    }

    #[test]
    fn ends_after_a_stop_although_a_process_keeps_the_pipe() {
        let (reader, mut writer) = pipe().unwrap();
        writer.write_all(b"last").unwrap();
        let (sender, received) = channel();
        relay(&reader.into(), &AtomicBool::new(true), |bytes| sender.send(bytes.to_vec()).unwrap());
        assert_eq!(received.try_iter().collect::<Vec<_>>(), [b"last".to_vec(), Vec::new()]);
        drop(writer);
    }
}
