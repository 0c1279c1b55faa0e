//! Reads a terminal on a separate thread and passes on the bytes with their arrival. A read of a
//! terminal waits for a kernel thread of normal priority, even if no byte has arrived (`flush_work`
//! in Linux, `drivers/tty/tty_buffer.c`). A control loop with real-time priority must not wait for
//! that thread.

use crate::link::LinkError;
use crate::tty::{Tty, poll_until};
use rtrb::{Consumer, Producer, RingBuffer};
use rustix::event::{EventfdFlags, PollFlags, eventfd};
use rustix::fd::OwnedFd;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

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
