//! Passes the rows of a trial to a live view, which may miss rows but no counts.
//!
//! ```text
//!   loop ── row ─┬─ record: a Vec, or the queue of `row_queue`
//!                └─ TapWriter ── bounded queue without locks ── TapReader
//! ```
//!
//! The loop neither waits nor allocates for a reader: if the queue is full, the row is counted and dropped. The record
//! does not pass through here, so a live view cannot change it.

use platebench_trace::{Flags, Row};
use rtrb::{Consumer, Producer, RingBuffer};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Half a second of the densest default trace in real time: four megabytes.
const CAPACITY: usize = 1 << 15;
/// Classes of [`TapCounts::lateness`].
pub const LATENESS_CLASSES: usize = 16;

/// A row with its trial.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TapRow {
    /// The scenario's number in the plan, from 0.
    pub scenario: usize,
    /// The trial's number, from 0.
    pub trial: u32,
    /// The recorded row.
    pub row: Row,
}

/// Counts over all trials that the tap followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TapCounts {
    /// Rows.
    pub rows: u64,
    /// Rows that did not fit into the queue.
    pub dropped_rows: u64,
    /// Control instants at which the bench was too late.
    pub overruns: u64,
    /// Samples without a reply at the next control instant.
    pub missed_replies: u64,
    /// Frames with a wrong checksum or form.
    pub rejected_frames: u64,
    /// Control instants by the bench's lateness: below 1 µs, below 2 µs, then powers of two; the last class is open.
    pub lateness: [u64; LATENESS_CLASSES],
}

/// [`TapCounts`] that one thread writes and another reads.
#[derive(Debug, Default)]
struct AtomicTapCounts {
    rows: AtomicU64,
    dropped_rows: AtomicU64,
    overruns: AtomicU64,
    missed_replies: AtomicU64,
    rejected_frames: AtomicU64,
    lateness: [AtomicU64; LATENESS_CLASSES],
}

/// Adds without a locked instruction: only one thread writes.
fn add_unshared(counter: &AtomicU64, count: u64) {
    counter.store(counter.load(Ordering::Relaxed).wrapping_add(count), Ordering::Relaxed);
}

/// The class of a lateness in µs.
fn lateness_class(lateness_us: f64) -> usize {
    // The bit length of an integer is the power of two above it. Negative values and NaN become 0.
    let bits = u64::BITS - (lateness_us as u64).leading_zeros();
    (bits as usize).min(LATENESS_CLASSES - 1)
}

/// The loop's end of the tap.
#[derive(Debug)]
pub struct TapWriter {
    producer: Producer<TapRow>,
    counters: Arc<AtomicTapCounts>,
    scenario: usize,
    trial: u32,
    /// Refused frames of this trial that were counted.
    rejected_frames: u64,
}

impl TapWriter {
    /// Attributes the next rows to this trial.
    fn start_trial(&mut self, scenario: usize, trial: u32) {
        (self.scenario, self.trial, self.rejected_frames) = (scenario, trial, 0);
    }

    /// Passes on a row, or counts it as dropped. Neither waits nor allocates.
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

    /// Counts samples without a reply.
    pub(crate) fn count_missed_replies(&mut self, count: u64) {
        add_unshared(&self.counters.missed_replies, count);
    }

    /// Sets the total of rejected frames of this trial.
    pub(crate) fn set_rejected_frames(&mut self, of_trial: u64) {
        add_unshared(&self.counters.rejected_frames, of_trial.saturating_sub(self.rejected_frames));
        self.rejected_frames = of_trial;
    }
}

/// The live view's end of the tap.
#[derive(Debug)]
pub struct TapReader {
    consumer: Consumer<TapRow>,
    counters: Arc<AtomicTapCounts>,
}

impl TapReader {
    /// The oldest row that was not read yet.
    pub fn next_row(&mut self) -> Option<TapRow> {
        self.consumer.pop().ok()
    }

    /// The counts so far, each read at a slightly different instant.
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

/// Lets a live view follow one trial at a time: the next that starts while none is followed. The default follows none.
#[derive(Debug, Clone, Default)]
pub struct LiveTap(Option<Arc<Mutex<Option<TapWriter>>>>);

impl LiveTap {
    /// A tap and its reader.
    pub fn new() -> (Self, TapReader) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, TapReader) {
        let (producer, consumer) = RingBuffer::new(capacity);
        let counters = Arc::new(AtomicTapCounts::default());
        let viewer = TapReader { consumer, counters: Arc::clone(&counters) };
        let tap = TapWriter { producer, counters, scenario: 0, trial: 0, rejected_frames: 0 };
        (Self(Some(Arc::new(Mutex::new(Some(tap))))), viewer)
    }

    /// The writer for a trial that starts, unless another trial has it. Not for use in a trial's loop: it locks.
    pub fn acquire(&self, scenario: usize, trial: u32) -> TapGuard<'_> {
        let slot = self.0.as_deref();
        let mut tap = slot.and_then(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner).take());
        if let Some(tap) = &mut tap {
            tap.start_trial(scenario, trial);
        }
        TapGuard { slot, writer: tap }
    }
}

/// Returns the writer at the end of a trial.
#[derive(Debug)]
pub struct TapGuard<'a> {
    slot: Option<&'a Mutex<Option<TapWriter>>>,
    writer: Option<TapWriter>,
}

impl TapGuard<'_> {
    /// The writer, if this trial is followed.
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
