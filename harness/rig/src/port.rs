//! Exchanges messages over an open terminal and waits for answers.

use crate::line_reader::LineReader;
use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::pending_requests::{PendingRequests, Request};
use crate::tty::{Tty, disconnected};
use rustix::fd::OwnedFd;
use std::time::{Duration, Instant};

/// Longest time from a hello, a configuration or a sample to the answer. Answers usually arrive
/// earlier, even on a busy computer.
pub const DEFAULT_REPLY_TIMEOUT: Duration = Duration::from_millis(500);
/// Longest wait for the answer to another request, and for any answer while the line is silent.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(100);
/// Longest wait after a message that needs no answer.
const OPTIONAL_ANSWER_TIMEOUT: Duration = Duration::from_millis(1);
const WRITE_TIMEOUT: Duration = Duration::from_millis(100);
const READ_CHUNK_BYTES: usize = 512;

#[derive(Debug)]
pub struct Port<T> {
    // Declared, and so dropped, before `terminal`: the line hangs up with its last handle.
    reader: Option<LineReader>,
    terminal: T,
    pending_requests: PendingRequests,
    reply_timeout: Duration,
    /// True from a missing answer to the next answer.
    is_silent: bool,
}

impl Port<OwnedFd> {
    pub(crate) fn from_fd(file: OwnedFd) -> rustix::io::Result<Self> {
        rustix::io::ioctl_fionbio(&file, true)?;
        Ok(Self::new(file))
    }
}

impl<T: Tty> Port<T> {
    pub(crate) fn new(terminal: T) -> Self {
        Self {
            reader: None,
            terminal,
            pending_requests: PendingRequests::default(),
            reply_timeout: DEFAULT_REPLY_TIMEOUT,
            is_silent: false,
        }
    }

    #[must_use]
    pub fn with_reply_timeout(mut self, timeout: Duration) -> Self {
        self.reply_timeout = timeout;
        self
    }

    /// Uses `ANSWER_TIMEOUT` until the first answer, because the controller is still starting.
    pub(crate) fn expect_silence(&mut self) {
        self.is_silent = true;
    }

    /// After a missing answer, uses the shorter `ANSWER_TIMEOUT` until the next answer.
    fn answer_timeout(&self, request: Request) -> Duration {
        match request {
            Request::None => OPTIONAL_ANSWER_TIMEOUT,
            Request::Sample | Request::Setup if !self.is_silent => self.reply_timeout,
            Request::Sample | Request::Setup | Request::Other => self.reply_timeout.min(ANSWER_TIMEOUT),
        }
    }

    fn write(&mut self, mut bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            match self.terminal.write(bytes, deadline)? {
                Some(written) => bytes = bytes.get(written..).unwrap_or_default(),
                None => return Ok(()),
            }
        }
        Ok(())
    }

    fn read(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if let Some(reader) = &mut self.reader {
            return reader.read(until, bytes);
        }
        let mut chunk = [0; READ_CHUNK_BYTES];
        let Some(count) = self.terminal.read(&mut chunk, until)? else { return Ok(None) };
        let at = Instant::now();
        bytes.extend_from_slice(chunk.get(..count).unwrap_or_default());
        Ok(Some(at))
    }
}

impl<T: Tty> Link for Port<T> {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let request = self.pending_requests.send(bytes);
        let start = Instant::now();
        self.write(bytes, start + WRITE_TIMEOUT)?;
        let deadline = Instant::now() + self.answer_timeout(request);
        let mut read = answer.len();
        while let Some(at) = self.read(deadline, answer)? {
            let mut is_answered = false;
            for &byte in answer.get(read..).unwrap_or_default() {
                is_answered |= self.pending_requests.ends_wait(byte);
            }
            if is_answered {
                self.is_silent = false;
                return Ok(at.saturating_duration_since(start));
            }
            if at >= deadline {
                break;
            }
            read = answer.len();
        }
        self.is_silent |= request != Request::None;
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, _now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let now = Instant::now();
        while self.read(now, received)?.is_some_and(|at| at < now + OPTIONAL_ANSWER_TIMEOUT) {}
        Ok(())
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossy
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl<T: Tty> RealTimeLine for Port<T> {
    fn start(&mut self) -> Result<(), LinkError> {
        if self.reader.is_none()
            && let Some(line) = self.terminal.for_reading()
        {
            self.reader = Some(LineReader::start(line).map_err(disconnected)?);
        }
        Ok(())
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.write(bytes, Instant::now())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.read(until, bytes)
    }
}
