//! Reads and writes an open serial port, pseudo-terminal or network connection. End of file, `EIO`,
//! a broken pipe and a hang-up become [`LinkError::Disconnected`]. A successful write does not
//! prove that the other side is there.

use crate::link::LinkError;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::io::Errno;
use serialport::{SerialPort as _, TTYPort};
use std::io::{self, Read, Write};
use std::time::Instant;

pub trait Tty: Send {
    /// `None` if no bytes arrive by `until`.
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError>;

    /// Writes as many bytes as fit and returns their number; `None` if none fits by `until`.
    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError>;

    /// Second handle of the line, for a reading thread. `None` if a read also changes the state of
    /// `self`.
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

/// Repeats the non-blocking `transfer` until it succeeds; `None` after `until`.
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

/// Waits for `events`. Returns false on time-out, but true after a signal without an event.
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
