//! Passes the rows of a trial to a live view through a queue of fixed size.
//!
//! The trial loop neither waits nor allocates for the reader of the queue. If the queue is full,
//! the row is counted but dropped. So the view may miss rows, but its counts are complete.

use platebench_model::trace::{Flags, Row};
use rtrb::{Consumer, Producer, RingBuffer};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Number of rows, 4 MB. They cover more than 1 s at a trace step of 0.05 ms and a period of 1 ms.
const CAPACITY: usize = 1 << 15;
pub const LATENESS_CLASSES: usize = 16;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TapRow {
    pub scenario: usize,
    pub trial: u32,
    pub row: Row,
}

/// Sums over all trials that the tap has followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TapCounts {
    pub rows: u64,
    pub dropped_rows: u64,
    pub overruns: u64,
    /// Number of samples without a reply at the next control instant.
    pub missed_replies: u64,
    pub rejected_frames: u64,
    /// Number of control instants by lateness. Class n > 0 is from 2^(n−1) µs to below 2^n µs,
    /// class 0 is below 1 µs. The last class has no upper limit.
    pub lateness: [u64; LATENESS_CLASSES],
}

#[derive(Debug, Default)]
struct AtomicTapCounts {
    rows: AtomicU64,
    dropped_rows: AtomicU64,
    overruns: AtomicU64,
    missed_replies: AtomicU64,
    rejected_frames: AtomicU64,
    lateness: [AtomicU64; LATENESS_CLASSES],
}

/// Needs no atomic read-modify-write instruction, because only one thread writes the counter.
fn add_unshared(counter: &AtomicU64, count: u64) {
    counter.store(counter.load(Ordering::Relaxed).wrapping_add(count), Ordering::Relaxed);
}

fn lateness_class(lateness_us: f64) -> usize {
    // A number below 2^n has at most n bits. The cast turns negative values and NaN into 0.
    let bits = u64::BITS - (lateness_us as u64).leading_zeros();
    (bits as usize).min(LATENESS_CLASSES - 1)
}

#[derive(Debug)]
pub struct TapWriter {
    producer: Producer<TapRow>,
    counters: Arc<AtomicTapCounts>,
    scenario: usize,
    trial: u32,
    rejected_frames: u64,
}

impl TapWriter {
    fn start_trial(&mut self, scenario: usize, trial: u32) {
        (self.scenario, self.trial, self.rejected_frames) = (scenario, trial, 0);
    }

    pub(crate) fn push(&mut self, row: &Row) {
        let counters = &*self.counters;
        add_unshared(&counters.rows, 1);
        if row.flags.intersects(Flags::CONTROL | Flags::OVERRUN) {
            if let Some(counter) = counters.lateness.get(lateness_class(row.lateness_us)) {
                add_unshared(counter, 1);
            }
            add_unshared(&counters.overruns, u64::from(row.flags.contains(Flags::OVERRUN)));
        }
        let row = TapRow { scenario: self.scenario, trial: self.trial, row: *row };
        if self.producer.push(row).is_err() {
            add_unshared(&counters.dropped_rows, 1);
        }
    }

    pub(crate) fn count_missed_replies(&mut self, count: u64) {
        add_unshared(&self.counters.missed_replies, count);
    }

    pub(crate) fn set_rejected_frames(&mut self, of_trial: u64) {
        add_unshared(&self.counters.rejected_frames, of_trial.saturating_sub(self.rejected_frames));
        self.rejected_frames = of_trial;
    }
}

#[derive(Debug)]
pub struct TapReader {
    consumer: Consumer<TapRow>,
    counters: Arc<AtomicTapCounts>,
}

impl TapReader {
    pub fn next_row(&mut self) -> Option<TapRow> {
        self.consumer.pop().ok()
    }

    /// Reads the counts one after the other, so a row may be in one count and not yet in the next.
    pub fn counts(&self) -> TapCounts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let AtomicTapCounts { rows, dropped_rows, overruns, missed_replies, rejected_frames, lateness } =
            &*self.counters;
        TapCounts {
            rows: read(rows),
            dropped_rows: read(dropped_rows),
            overruns: read(overruns),
            missed_replies: read(missed_replies),
            rejected_frames: read(rejected_frames),
            lateness: lateness.each_ref().map(read),
        }
    }
}

/// Lends the writer of the queue to one trial at a time. The default value has no queue.
#[derive(Debug, Clone, Default)]
pub struct LiveTap(Option<Arc<Mutex<Option<TapWriter>>>>);

impl LiveTap {
    pub fn new() -> (Self, TapReader) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, TapReader) {
        let (producer, consumer) = RingBuffer::new(capacity);
        let counters = Arc::new(AtomicTapCounts::default());
        let tap_reader = TapReader { consumer, counters: Arc::clone(&counters) };
        let tap = TapWriter { producer, counters, scenario: 0, trial: 0, rejected_frames: 0 };
        (Self(Some(Arc::new(Mutex::new(Some(tap))))), tap_reader)
    }

    /// The guard has no writer if another trial holds it. This call takes a lock, so a trial loop
    /// must not make it.
    pub fn acquire(&self, scenario: usize, trial: u32) -> TapGuard<'_> {
        let slot = self.0.as_deref();
        let mut tap = slot.and_then(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner).take());
        if let Some(tap) = &mut tap {
            tap.start_trial(scenario, trial);
        }
        TapGuard { slot, writer: tap }
    }
}

#[derive(Debug)]
pub struct TapGuard<'a> {
    slot: Option<&'a Mutex<Option<TapWriter>>>,
    writer: Option<TapWriter>,
}

impl TapGuard<'_> {
    pub fn tap(&mut self) -> Option<&mut TapWriter> {
        self.writer.as_mut()
    }
}

impl Drop for TapGuard<'_> {
    fn drop(&mut self) {
        if let (Some(slot), Some(tap)) = (self.slot, self.writer.take()) {
            *slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(tap);
        }
    }
}

#[cfg(test)]
mod tests;
