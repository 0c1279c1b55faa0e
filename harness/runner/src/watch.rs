//! Whoever looks on while trials are played: a second queue, which may lose rows, and counts, which may not.
//!
//! ```text
//!   loop ── row ─┬─ the record's way: a Vec, or the bounded queue of `queue`
//!                └─ Tap ── bounded queue without locks ── Viewer, whenever it likes
//! ```
//!
//! The loop never waits for a viewer, allocates nothing for it and asks nothing of it: where the queue is full the row is counted and forgotten. The record does not pass here, so that nobody who looks on
//! can change a byte of it. Counts are kept on the loop's side, and are therefore right also where rows were lost.

use platebench_trace::{Flags, Row};
use rtrb::{Consumer, Producer, RingBuffer};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Rows that may be on their way to a viewer: half a second of the densest default trace in real time, four megabytes.
const CAPACITY: usize = 1 << 15;
/// Classes of lateness, see [`Counts::lateness`].
pub const LATENESS_CLASSES: usize = 16;

/// A row and the trial that it is of.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sight {
    /// The scenario's number in the plan, counted from 0.
    pub scenario: usize,
    /// The trial's number, counted from 0.
    pub trial: u32,
    /// What was recorded.
    pub row: Row,
}

/// What was counted since the watch began, over all trials that it followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Rows.
    pub rows: u64,
    /// Of these, the ones that no viewer got.
    pub dropped: u64,
    /// Control instants for which the bench was too late.
    pub overruns: u64,
    /// Samples without an answer when the next control instant came.
    pub misses: u64,
    /// Frames that could not be read: wrong checksum, wrong form.
    pub refused: u64,
    /// Control instants by how late the bench was: below 1 µs, below 2 µs, and so on by powers of two; the last class has no end.
    pub lateness: [u64; LATENESS_CLASSES],
}

/// [`Counts`], while one thread counts and another one reads.
#[derive(Debug, Default)]
struct Counters {
    rows: AtomicU64,
    dropped: AtomicU64,
    overruns: AtomicU64,
    misses: AtomicU64,
    refused: AtomicU64,
    lateness: [AtomicU64; LATENESS_CLASSES],
}

/// Adds where nobody else does, which needs no locked instruction.
fn add(counter: &AtomicU64, count: u64) {
    counter.store(counter.load(Ordering::Relaxed).wrapping_add(count), Ordering::Relaxed);
}

/// The class of a lateness in µs.
fn class(lateness_us: f64) -> usize {
    // The number of bits of a whole number is the power of two above it; what is negative or no number counts as 0.
    let bits = u64::BITS - (lateness_us as u64).leading_zeros();
    (bits as usize).min(LATENESS_CLASSES - 1)
}

/// The loop's end.
#[derive(Debug)]
pub struct Tap {
    producer: Producer<Sight>,
    counters: Arc<Counters>,
    scenario: usize,
    trial: u32,
    /// Refused frames of the trial that were counted.
    refused: u64,
}

impl Tap {
    /// From now on rows are of this trial.
    fn begin(&mut self, scenario: usize, trial: u32) {
        (self.scenario, self.trial, self.refused) = (scenario, trial, 0);
    }

    /// Shows a row, or counts that nobody saw it. Neither waits nor allocates.
    pub(crate) fn push(&mut self, row: &Row) {
        let counters = &*self.counters;
        add(&counters.rows, 1);
        if row.flags.intersects(Flags::CONTROL | Flags::OVERRUN) {
            if let Some(counter) = counters.lateness.get(class(row.lateness_us)) {
                add(counter, 1);
            }
            add(&counters.overruns, u64::from(row.flags.contains(Flags::OVERRUN)));
        }
        let sight = Sight { scenario: self.scenario, trial: self.trial, row: *row };
        if self.producer.push(sight).is_err() {
            add(&counters.dropped, 1);
        }
    }

    /// Counts samples that were not answered in time.
    pub(crate) fn miss(&mut self, count: u64) {
        add(&self.counters.misses, count);
    }

    /// So many frames of this trial could not be read so far.
    pub(crate) fn refused(&mut self, of_trial: u64) {
        add(&self.counters.refused, of_trial.saturating_sub(self.refused));
        self.refused = of_trial;
    }
}

/// The onlooker's end.
#[derive(Debug)]
pub struct Viewer {
    consumer: Consumer<Sight>,
    counters: Arc<Counters>,
}

impl Viewer {
    /// The oldest row that was not taken yet, if there is one.
    pub fn take(&mut self) -> Option<Sight> {
        self.consumer.pop().ok()
    }

    /// What was counted so far. Counts of one instant may be apart by what happens meanwhile.
    pub fn counts(&self) -> Counts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Counters { rows, dropped, overruns, misses, refused, lateness } = &*self.counters;
        Counts {
            rows: read(rows),
            dropped: read(dropped),
            overruns: read(overruns),
            misses: read(misses),
            refused: read(refused),
            lateness: lateness.each_ref().map(read),
        }
    }
}

/// Lets one trial at a time be looked at: whichever begins while no other one is. The default is that nobody looks.
#[derive(Debug, Clone, Default)]
pub struct Watch(Option<Arc<Mutex<Option<Tap>>>>);

impl Watch {
    /// A watch, and who looks.
    pub fn new() -> (Self, Viewer) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, Viewer) {
        let (producer, consumer) = RingBuffer::new(capacity);
        let counters = Arc::new(Counters::default());
        let viewer = Viewer { consumer, counters: Arc::clone(&counters) };
        let tap = Tap { producer, counters, scenario: 0, trial: 0, refused: 0 };
        (Self(Some(Arc::new(Mutex::new(Some(tap))))), viewer)
    }

    /// The tap for a trial that begins, unless another one is being looked at. Before the trial's first control instant, never in its loop.
    pub fn lend(&self, scenario: usize, trial: u32) -> Lent<'_> {
        let place = self.0.as_deref();
        let mut tap = place.and_then(|place| place.lock().unwrap_or_else(PoisonError::into_inner).take());
        if let Some(tap) = &mut tap {
            tap.begin(scenario, trial);
        }
        Lent { place, tap }
    }
}

/// A tap for the length of a trial.
#[derive(Debug)]
pub struct Lent<'a> {
    place: Option<&'a Mutex<Option<Tap>>>,
    tap: Option<Tap>,
}

impl Lent<'_> {
    /// The tap, where this trial is looked at.
    pub fn tap(&mut self) -> Option<&mut Tap> {
        self.tap.as_mut()
    }
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        if let (Some(place), Some(tap)) = (self.place, self.tap.take()) {
            *place.lock().unwrap_or_else(PoisonError::into_inner) = Some(tap);
        }
    }
}

#[cfg(test)]
mod tests;
