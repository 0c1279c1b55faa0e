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
mod tests {
    use super::*;
    use allocation_counter::{AllocationInfo, measure};

    fn row(t_s: f64, lateness_us: f64, flags: Flags) -> Row {
        Row { t_s, lateness_us, flags, ..Row::default() }
    }

    fn push_rows(live_tap: &LiveTap, rows: &[Row]) {
        let mut guard = live_tap.acquire(0, 0);
        for row in rows {
            guard.tap().unwrap().push(row);
        }
    }

    #[test]
    fn returns_rows_in_order_with_their_trial() {
        let (live_tap, mut reader) = LiveTap::with_capacity(8);
        for (scenario, trial) in [(0, 0), (2, 7)] {
            let mut guard = live_tap.acquire(scenario, trial);
            for t_s in [0.0, 1.0] {
                guard.tap().unwrap().push(&row(t_s, 0.0, Flags::empty()));
            }
        }
        let seen: Vec<_> =
            std::iter::from_fn(|| reader.next_row()).map(|row| (row.scenario, row.trial, row.row.t_s)).collect();
        assert_eq!(seen, [(0, 0, 0.0), (0, 0, 1.0), (2, 7, 0.0), (2, 7, 1.0)]);
    }

    #[test]
    fn a_full_queue_loses_rows_but_no_count() {
        let (live_tap, reader) = LiveTap::with_capacity(4);
        let rows: Vec<_> =
            (0..100).map(|number| row(f64::from(number), 3.0, Flags::CONTROL | Flags::OVERRUN)).collect();
        push_rows(&live_tap, &rows);
        let counts = reader.counts();
        assert_eq!((counts.rows, counts.dropped_rows, counts.overruns, counts.lateness[2]), (100, 96, 100, 100));
    }

    #[test]
    fn push_allocates_nothing() {
        let (live_tap, mut reader) = LiveTap::with_capacity(16);
        let mut guard = live_tap.acquire(0, 0);
        let tap = guard.tap().unwrap();
        let row = row(0.0, 1e9, Flags::CONTROL);
        for room in [true, false] {
            let allocated = measure(|| (0..16).for_each(|_| tap.push(&row)));
            assert_eq!(allocated, AllocationInfo::default(), "room: {room}");
        }
        assert_eq!(reader.counts().dropped_rows, 16);
        assert!(reader.next_row().is_some());
    }

    #[test]
    fn lateness_classes_are_powers_of_two() {
        let cases = [
            (0.0, 0),
            (0.999, 0),
            (1.0, 1),
            (1.999, 1),
            (2.0, 2),
            (1_023.9, 10),
            (1_024.0, 11),
            (16_383.9, 14),
            (16_384.0, 15),
            (1e30, 15),
            (f64::INFINITY, 15),
            (f64::NAN, 0),
            (-1.0, 0),
        ];
        for (lateness_us, expected) in cases {
            assert_eq!(lateness_class(lateness_us), expected, "{lateness_us} µs");
        }
    }

    #[test]
    fn counts_lateness_at_control_instants_only() {
        let (live_tap, reader) = LiveTap::with_capacity(8);
        // The three rows lie between control instants, at one, and at a skipped one.
        push_rows(&live_tap, &[Flags::empty(), Flags::CONTROL, Flags::OVERRUN].map(|flags| row(0.0, 0.5, flags)));
        assert_eq!(reader.counts().lateness.iter().sum::<u64>(), 2);
    }

    #[test]
    fn rejected_frames_add_up_over_trials() {
        let (live_tap, reader) = LiveTap::with_capacity(8);
        for so_far in [[1, 3], [0, 2]] {
            let mut guard = live_tap.acquire(0, 0);
            for count in so_far {
                guard.tap().unwrap().set_rejected_frames(count);
            }
        }
        assert_eq!(reader.counts().rejected_frames, 5);
    }

    #[test]
    fn follows_one_trial_at_a_time() {
        let (live_tap, _reader) = LiveTap::with_capacity(8);
        let mut first = live_tap.acquire(0, 0);
        assert!(first.tap().is_some());
        assert!(live_tap.acquire(0, 1).tap().is_none(), "the first trial has the tap");
        drop(first);
        assert!(live_tap.acquire(0, 2).tap().is_some());
        assert!(LiveTap::default().acquire(0, 0).tap().is_none(), "no live view");
    }
}
