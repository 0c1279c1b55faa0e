//! An open terminal with a controller behind it: a serial port, or our end of a pseudo-terminal.
//!
//! Deadlines are waited for in nanoseconds. However the other side goes (end of file, `EIO`, a broken pipe, a hang-up), it is one
//! [`LinkError::Disconnected`]; that a write succeeded proves nothing.

use crate::asked::{self, Asked};
use crate::link::{Line, LinkError};
use platebench_wire::FrameReader;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::io::Errno;
use serialport::{SerialPort as _, TTYPort};
use std::io::{self, Read, Write};
use std::time::{Duration, Instant};

/// An answer that is not whole this long after its question is none.
const PATIENCE: Duration = Duration::from_millis(100);
/// What needs no answer may still have one: how long to listen for it.
const AFTERTHOUGHT: Duration = Duration::from_millis(1);
/// A line that takes nothing for this long is full for good.
const FULL: Duration = Duration::from_millis(100);
/// Taken from the line at a time.
const CHUNK: usize = 512;

/// What bytes go through.
pub(crate) trait Terminal: Send {
    /// Reads what there is once there is something; `None` where nothing came by `until`.
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError>;

    /// Writes as much as the line takes once it takes something; `None` where it took nothing by `until`.
    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError>;
}

/// A terminal that never blocks, waited for with `ppoll`.
impl Terminal for OwnedFd {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        let mut over = false;
        loop {
            match rustix::io::read(&*self, &mut *buffer) {
                Ok(0) | Err(Errno::IO) => return Err(gone("the other side has hung up")),
                Ok(count) => return Ok(Some(count)),
                Err(Errno::AGAIN) if over => return Ok(None),
                Err(Errno::AGAIN) => over = !wait(self, PollFlags::IN, until)?,
                Err(Errno::INTR) => {}
                Err(error) => return Err(gone(error)),
            }
        }
    }

    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError> {
        let mut over = false;
        loop {
            match rustix::io::write(&*self, bytes) {
                Ok(written) => return Ok(Some(written)),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) if over => return Ok(None),
                Err(Errno::AGAIN) => over = !wait(self, PollFlags::OUT, until)?,
                Err(error) => return Err(gone(error)),
            }
        }
    }
}

/// A serial port, which waits by itself: with `ppoll` as well.
impl Terminal for TTYPort {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        in_time(self, until, |port| Read::read(port, buffer)).and_then(|count| match count {
            Some(0) => Err(gone("the other side has hung up")),
            count => Ok(count),
        })
    }

    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError> {
        in_time(self, until, |port| Write::write(port, bytes))
    }
}

/// Does `what` with what is left of the time as its own patience.
fn in_time(
    port: &mut TTYPort,
    until: Instant,
    mut what: impl FnMut(&mut TTYPort) -> io::Result<usize>,
) -> Result<Option<usize>, LinkError> {
    loop {
        port.set_timeout(until.saturating_duration_since(Instant::now())).map_err(gone)?;
        match what(port) {
            Ok(count) => return Ok(Some(count)),
            Err(error) if error.kind() == io::ErrorKind::TimedOut => return Ok(None),
            // A signal is looked at by others.
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(gone(error)),
        }
    }
}

/// See the module.
#[derive(Debug)]
pub(crate) struct Port<T> {
    terminal: T,
    asked: Asked,
    answers: FrameReader,
}

fn gone(why: impl std::fmt::Display) -> LinkError {
    LinkError::Disconnected(why.to_string())
}

/// How long it still is to `instant`.
fn left(instant: Instant) -> Timespec {
    let left = instant.saturating_duration_since(Instant::now());
    Timespec { tv_sec: i64::try_from(left.as_secs()).unwrap_or(i64::MAX), tv_nsec: left.subsec_nanos().into() }
}

/// Waits for `events` until `instant`. True where there may be some.
fn wait(file: &OwnedFd, events: PollFlags, instant: Instant) -> Result<bool, LinkError> {
    let mut descriptors = [PollFd::new(file, events)];
    match poll(&mut descriptors, Some(&left(instant))) {
        Ok(0) => Ok(false),
        // Whatever else it is, the next read or write says it. A signal is looked at by others.
        Ok(_) | Err(Errno::INTR) => Ok(true),
        Err(error) => Err(gone(error)),
    }
}

impl Port<OwnedFd> {
    /// Takes over `file`, a terminal in raw mode.
    pub(crate) fn of_file(file: OwnedFd) -> rustix::io::Result<Self> {
        rustix::io::ioctl_fionbio(&file, true)?;
        Ok(Self::new(file))
    }
}

impl<T: Terminal> Port<T> {
    /// Takes over a terminal in raw mode.
    pub(crate) fn new(terminal: T) -> Self {
        Self { terminal, asked: Asked::default(), answers: FrameReader::new() }
    }

    /// Writes as much of `bytes` as the line takes by `deadline`.
    fn write(&mut self, mut bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            match self.terminal.write(bytes, deadline)? {
                Some(written) => bytes = bytes.get(written..).unwrap_or_default(),
                None => return Ok(()),
            }
        }
        Ok(())
    }

    /// See [`crate::Link::exchange`]: the wall's time until the last byte of the answer was there.
    pub(crate) fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let expected = self.asked.expects(bytes);
        let since = Instant::now();
        self.write(bytes, since + FULL)?;
        let deadline = Instant::now() + if expected.is_some() { PATIENCE } else { AFTERTHOUGHT };
        let mut read = answer.len();
        while let Some(at) = self.receive(deadline, answer)? {
            let mut answered = false;
            for &byte in answer.get(read..).unwrap_or_default() {
                let Some(Ok(body)) = self.answers.push(byte) else { continue };
                answered |= expected.is_some_and(|sequence| asked::answers(body, sequence));
            }
            if answered {
                return Ok(at.saturating_duration_since(since));
            }
            if at >= deadline {
                break;
            }
            read = answer.len();
        }
        Ok(Duration::ZERO)
    }

    /// See [`crate::Link::pass`]: what is there already.
    pub(crate) fn pass(&mut self, said: &mut Vec<u8>) -> Result<(), LinkError> {
        let now = Instant::now();
        while self.receive(now, said)?.is_some_and(|at| at < now + AFTERTHOUGHT) {}
        Ok(())
    }
}

impl<T: Terminal> Line for Port<T> {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.write(bytes, Instant::now())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let mut chunk = [0; CHUNK];
        let Some(count) = self.terminal.read(&mut chunk, until)? else { return Ok(None) };
        let at = Instant::now();
        bytes.extend_from_slice(chunk.get(..count).unwrap_or_default());
        Ok(Some(at))
    }
}
