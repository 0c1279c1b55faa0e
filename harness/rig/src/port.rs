//! An open terminal with a controller behind it: a serial port, or our end of a pseudo-terminal.
//!
//! Deadlines are waited for with `ppoll`, in nanoseconds. However the other side goes (end of file, `EIO`, a broken pipe, a hang-up), it is one
//! [`LinkError::Disconnected`]; that a write succeeded proves nothing.

use crate::asked::{self, Asked};
use crate::link::{Line, LinkError};
use platebench_wire::FrameReader;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::io::Errno;
use std::time::{Duration, Instant};

/// An answer that is not whole this long after its question is none.
const PATIENCE: Duration = Duration::from_millis(100);
/// What needs no answer may still have one: how long to listen for it.
const AFTERTHOUGHT: Duration = Duration::from_millis(1);
/// A line that takes nothing for this long is full for good.
const FULL: Duration = Duration::from_millis(100);
/// Taken from the line at a time.
const CHUNK: usize = 512;

/// See the module.
#[derive(Debug)]
pub(crate) struct Port {
    /// Never blocks.
    file: OwnedFd,
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

impl Port {
    /// Takes over `file`, a terminal in raw mode.
    pub(crate) fn new(file: OwnedFd) -> rustix::io::Result<Self> {
        rustix::io::ioctl_fionbio(&file, true)?;
        Ok(Self { file, asked: Asked::default(), answers: FrameReader::new() })
    }

    /// Waits for `events` until `instant`. True where there may be some.
    fn wait(&self, events: PollFlags, instant: Instant) -> Result<bool, LinkError> {
        let mut descriptors = [PollFd::new(&self.file, events)];
        match poll(&mut descriptors, Some(&left(instant))) {
            Ok(0) => Ok(false),
            // Whatever else it is, the next read or write says it. A signal is looked at by others.
            Ok(_) | Err(Errno::INTR) => Ok(true),
            Err(error) => Err(gone(error)),
        }
    }

    /// Writes as much of `bytes` as the line takes by `deadline`, `None` for what it takes at once.
    fn write(&self, mut bytes: &[u8], deadline: Option<Instant>) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            match rustix::io::write(&self.file, bytes) {
                Ok(written) => bytes = bytes.get(written..).unwrap_or_default(),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => match deadline {
                    Some(deadline) if self.wait(PollFlags::OUT, deadline)? => {}
                    _ => return Ok(()),
                },
                Err(error) => return Err(gone(error)),
            }
        }
        Ok(())
    }

    /// See [`crate::Link::exchange`]: the wall's time until the last byte of the answer was there.
    pub(crate) fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let expected = self.asked.expects(bytes);
        let since = Instant::now();
        self.write(bytes, Some(since + FULL))?;
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

impl Line for Port {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.write(bytes, None)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let mut chunk = [0; CHUNK];
        let mut over = false;
        loop {
            match rustix::io::read(&self.file, &mut chunk) {
                Ok(0) | Err(Errno::IO) => return Err(gone("the other side has hung up")),
                Ok(count) => {
                    let at = Instant::now();
                    bytes.extend_from_slice(chunk.get(..count).unwrap_or_default());
                    return Ok(Some(at));
                }
                Err(Errno::AGAIN) if over => return Ok(None),
                Err(Errno::AGAIN) => over = !self.wait(PollFlags::IN, until)?,
                Err(Errno::INTR) => {}
                Err(error) => return Err(gone(error)),
            }
        }
    }
}
