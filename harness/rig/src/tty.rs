//! Reads and writes an open serial port, pseudo-terminal or network connection. End of file, `EIO`,
//! a broken pipe and a hang-up become [`LinkError::Disconnected`]. A successful write does not
//! prove that the other side is there.
//!
//! In real time, a separate thread reads the line and passes on the bytes with their arrival. A read
//! of a terminal waits for a kernel thread of normal priority, even if no byte has arrived
//! (`flush_work` in Linux, `drivers/tty/tty_buffer.c`). A control loop with real-time priority must
//! not wait for that thread.

use crate::link::LinkError;
use rtrb::{Consumer, Producer, RingBuffer};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::fd::OwnedFd;
use rustix::io::Errno;
use serialport::{SerialPort as _, TTYPort};
use std::io::{Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use std::{io, thread};

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

const CHUNK_BYTES: usize = 256;
const CHUNKS: usize = 256;
/// The thread ends at most this time after the reader is dropped.
const STOP_INTERVAL: Duration = Duration::from_millis(20);
const FULL_WAIT: Duration = Duration::from_millis(1);

#[derive(Debug)]
struct Chunk {
    at: Instant,
    count: usize,
    bytes: [u8; CHUNK_BYTES],
}

#[derive(Debug)]
pub(crate) struct LineReader {
    chunks: Consumer<Chunk>,
    /// Event that is readable after the thread has added a chunk.
    arrived: Arc<OwnedFd>,
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<Option<LinkError>>>,
    end: Option<String>,
}

impl LineReader {
    /// The thread inherits the scheduling class of the caller.
    pub(crate) fn start(line: Box<dyn Tty>) -> io::Result<Self> {
        let (producer, chunks) = RingBuffer::new(CHUNKS);
        let arrived = Arc::new(eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC)?);
        let is_stopped = Arc::new(AtomicBool::new(false));
        let worker = Worker { line, producer, arrived: Arc::clone(&arrived), is_stopped: Arc::clone(&is_stopped) };
        let thread = thread::Builder::new().name("line".to_owned()).spawn(move || worker.run().err())?;
        Ok(Self { chunks, arrived, is_stopped, thread: Some(thread), end: None })
    }

    /// Like `RealTimeLine::receive`. Calls the kernel only to sleep.
    pub(crate) fn read(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        loop {
            // Checked before the queue is read, because the last chunks precede the end.
            let is_ended = self.chunks.is_abandoned();
            if let Ok(chunk) = self.chunks.pop() {
                bytes.extend_from_slice(chunk.bytes.get(..chunk.count).unwrap_or_default());
                return Ok(Some(chunk.at));
            }
            if is_ended {
                return Err(LinkError::Disconnected(self.end_reason().to_owned()));
            }
            if Instant::now() >= until {
                return Ok(None);
            }
            poll_until(&self.arrived, PollFlags::IN, until).map_err(crate::tty::disconnected)?;
            // Clears the event; fails if there is none.
            let _ = rustix::io::read(&*self.arrived, &mut [0; 8]);
        }
    }

    fn end_reason(&mut self) -> &str {
        let thread = &mut self.thread;
        self.end.get_or_insert_with(|| match thread.take().and_then(|thread| thread.join().ok()).flatten() {
            Some(LinkError::Disconnected(reason)) => reason,
            _ => "the thread that reads the line has ended".to_owned(),
        })
    }
}

impl Drop for LineReader {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Worker {
    line: Box<dyn Tty>,
    producer: Producer<Chunk>,
    arrived: Arc<OwnedFd>,
    is_stopped: Arc<AtomicBool>,
}

impl Worker {
    fn run(mut self) -> Result<(), LinkError> {
        let result = self.read_until_stopped();
        let Self { producer, arrived, .. } = self;
        // Dropped before the wake, so that the control loop then sees the end of the queue.
        drop(producer);
        wake(&arrived);
        result
    }

    fn read_until_stopped(&mut self) -> Result<(), LinkError> {
        let mut bytes = [0; CHUNK_BYTES];
        while !self.is_stopped.load(Ordering::Relaxed) {
            if self.producer.is_full() {
                thread::sleep(FULL_WAIT);
                continue;
            }
            let Some(count) = self.line.read(&mut bytes, Instant::now() + STOP_INTERVAL)? else { continue };
            // The push cannot fail, because only this thread adds chunks.
            let _ = self.producer.push(Chunk { at: Instant::now(), count, bytes });
            wake(&self.arrived);
        }
        Ok(())
    }
}

fn wake(arrived: &OwnedFd) {
    // Fails only if 2⁶⁴ − 2 wakes are unread.
    let _ = rustix::io::write(arrived, &1_u64.to_ne_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(20);
    const NEVER: Duration = Duration::from_hours(10);

    fn reader() -> (LineReader, OwnedFd) {
        let (line, other) = io::pipe().unwrap();
        rustix::io::ioctl_fionbio(&line, true).unwrap();
        (LineReader::start(Box::new(OwnedFd::from(line))).unwrap(), other.into())
    }

    #[test]
    fn bytes_come_in_order_and_none_is_lost() {
        let (mut reader, other) = reader();
        let sent: Vec<u8> = (0..2 * CHUNKS * CHUNK_BYTES).map(|index| (index % 251) as u8).collect();
        let expected = sent.clone();
        let writer = thread::spawn(move || {
            let mut rest = &*sent;
            while !rest.is_empty() {
                rest = &rest[rustix::io::write(&other, rest).unwrap()..];
            }
            other
        });
        let mut received = Vec::new();
        let mut last = None;
        while received.len() < expected.len() {
            let at = reader.read(Instant::now() + LONG, &mut received).unwrap();
            assert!(at.is_some() && at >= last, "{at:?} after {last:?}");
            last = at;
        }
        assert!(received == expected);
        drop(writer.join().unwrap());
    }

    #[test]
    fn nothing_arrives_until_the_deadline() {
        let (mut reader, other) = reader();
        let mut bytes = Vec::new();
        assert!(matches!(reader.read(Instant::now(), &mut bytes), Ok(None)));
        assert!(matches!(reader.read(Instant::now() + STOP_INTERVAL, &mut bytes), Ok(None)));
        rustix::io::write(&other, b"late").unwrap();
        assert!(reader.read(Instant::now() + LONG, &mut bytes).unwrap().is_some());
        assert_eq!(bytes, b"late");
    }

    /// If the end does not wake the reader, this test takes ten hours.
    #[test]
    fn the_last_bytes_come_before_the_end() {
        let (mut reader, other) = reader();
        rustix::io::write(&other, b"last").unwrap();
        drop(other);
        let mut bytes = Vec::new();
        assert!(reader.read(Instant::now() + LONG, &mut bytes).unwrap().is_some());
        assert_eq!(bytes, b"last");
        for _ in 0..2 {
            let end = reader.read(Instant::now() + NEVER, &mut bytes).unwrap_err().to_string();
            assert!(end.ends_with("the other side has hung up"), "{end}");
        }
    }
}
