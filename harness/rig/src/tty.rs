//! Exchanges bytes over an open terminal: a serial port, or the bench's end of a pseudo-terminal.
//! End of file, `EIO`, a broken pipe and a hang-up all become [`LinkError::Disconnected`]. A
//! successful write does not prove that the other side is there.

use crate::line_reader::LineReader;
use crate::link::{LinkError, RealTimeLine};
use crate::pending_requests::{PendingRequests, Request};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::io::Errno;
use serialport::{SerialPort as _, TTYPort};
use std::io::{self, Read, Write};
use std::time::{Duration, Instant};

/// Counts from the last byte of a hello, a configuration or a sample. Longer than a busy computer
/// usually needs to run the controller's process.
pub const DEFAULT_REPLY_TIMEOUT: Duration = Duration::from_millis(500);
/// Applies to other answers, and to a reply after one that did not come.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(100);
/// Applies to a message that needs no answer.
const OPTIONAL_ANSWER_TIMEOUT: Duration = Duration::from_millis(1);
/// Time without progress.
const WRITE_TIMEOUT: Duration = Duration::from_millis(100);
const READ_CHUNK_BYTES: usize = 512;

pub(crate) trait Tty: Send {
    /// `None` if no bytes arrive by `until`.
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError>;

    /// Writes as much as fits; `None` if nothing fits by `until`.
    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError>;

    /// Another handle of the line, for a thread that reads. `None` if a read changes more than the line.
    fn for_reading(&self) -> Option<Box<dyn Tty>> {
        None
    }
}

impl Tty for OwnedFd {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        let read = retry_until(self, PollFlags::IN, until, |file| rustix::io::read(file, &mut *buffer));
        match read {
            Ok(Some(0)) | Err(Errno::IO) => Err(disconnected("the other side has hung up")),
            result => result.map_err(disconnected),
        }
    }

    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError> {
        retry_until(self, PollFlags::OUT, until, |file| rustix::io::write(file, bytes)).map_err(disconnected)
    }

    fn for_reading(&self) -> Option<Box<dyn Tty>> {
        self.try_clone().ok().map(|line| -> Box<dyn Tty> { Box::new(line) })
    }
}

/// Repeats a non-blocking `transfer`; `None` after `until`.
fn retry_until(
    file: &OwnedFd,
    events: PollFlags,
    until: Instant,
    mut transfer: impl FnMut(&OwnedFd) -> rustix::io::Result<usize>,
) -> rustix::io::Result<Option<usize>> {
    let mut is_over = false;
    loop {
        match transfer(file) {
            Ok(count) => return Ok(Some(count)),
            Err(Errno::INTR) => {}
            Err(Errno::AGAIN) if is_over => return Ok(None),
            Err(Errno::AGAIN) => is_over = !poll_until(file, events, until)?,
            Err(error) => return Err(error),
        }
    }
}

/// True if there may be events: the next read or write finds out.
pub(crate) fn poll_until(file: &OwnedFd, events: PollFlags, instant: Instant) -> rustix::io::Result<bool> {
    let left = instant.saturating_duration_since(Instant::now());
    let left =
        Timespec { tv_sec: i64::try_from(left.as_secs()).unwrap_or(i64::MAX), tv_nsec: left.subsec_nanos().into() };
    match poll(&mut [PollFd::new(file, events)], Some(&left)) {
        Ok(count) => Ok(count > 0),
        Err(Errno::INTR) => Ok(true),
        Err(error) => Err(error),
    }
}

impl Tty for TTYPort {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        match with_timeout(self, until, |port| Read::read(port, buffer)) {
            Ok(Some(0)) => Err(disconnected("the other side has hung up")),
            result => result,
        }
    }

    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError> {
        with_timeout(self, until, |port| Write::write(port, bytes))
    }

    fn for_reading(&self) -> Option<Box<dyn Tty>> {
        self.try_clone_native().ok().map(|port| -> Box<dyn Tty> { Box::new(port) })
    }
}

fn with_timeout(
    port: &mut TTYPort,
    until: Instant,
    mut transfer: impl FnMut(&mut TTYPort) -> io::Result<usize>,
) -> Result<Option<usize>, LinkError> {
    loop {
        port.set_timeout(until.saturating_duration_since(Instant::now())).map_err(disconnected)?;
        match transfer(port) {
            Ok(count) => return Ok(Some(count)),
            Err(error) if error.kind() == io::ErrorKind::TimedOut => return Ok(None),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(disconnected(error)),
        }
    }
}

pub(crate) fn disconnected(cause: impl std::fmt::Display) -> LinkError {
    LinkError::Disconnected(cause.to_string())
}

#[derive(Debug)]
pub(crate) struct Port<T> {
    // Declared before `terminal`: its handle closes first, so the line hangs up with the port.
    reader: Option<LineReader>,
    terminal: T,
    pending_requests: PendingRequests,
    reply_timeout: Duration,
    /// True from a missed reply to the next answer.
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

    pub(crate) fn set_reply_timeout(&mut self, timeout: Duration) {
        self.reply_timeout = timeout;
    }

    /// Uses the short wait until the first answer, because the controller is still starting.
    pub(crate) fn expect_silence(&mut self) {
        self.is_silent = true;
    }

    /// A silent controller costs the long wait once.
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

    /// The delay is wall time up to the last byte of the answer.
    pub(crate) fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let request = self.pending_requests.send(bytes);
        let start = Instant::now();
        self.write(bytes, start + WRITE_TIMEOUT)?;
        let deadline = Instant::now() + self.answer_timeout(request);
        let mut read = answer.len();
        while let Some(at) = self.read(deadline, answer)? {
            let mut is_answered = false;
            for &byte in answer.get(read..).unwrap_or_default() {
                is_answered |= self.pending_requests.is_answered_by(byte);
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

    pub(crate) fn read_available(&mut self, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let now = Instant::now();
        while self.read(now, received)?.is_some_and(|at| at < now + OPTIONAL_ANSWER_TIMEOUT) {}
        Ok(())
    }
}

impl<T: Tty> RealTimeLine for Port<T> {
    /// From now on a separate thread reads.
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
