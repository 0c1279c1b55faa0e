//! The rows' way out of a loop that must not wait: a bounded queue without locks, and a thread that empties it.

use crate::stage::Rows;
use platebench_trace::Row;
use rtrb::{Consumer, Producer, RingBuffer};
use std::thread;
use std::time::Duration;

/// Rows that may be on their way: more than a second of the densest default trace at 1 kHz.
const CAPACITY: usize = 1 << 15;
/// The queue takes hundreds of times as long to fill.
const NAP: Duration = Duration::from_millis(2);

/// The loop's end.
pub(crate) struct Queue {
    producer: Producer<Row>,
    lost: u64,
}

impl Queue {
    /// Both ends.
    pub(crate) fn new() -> (Self, Consumer<Row>) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, Consumer<Row>) {
        let (producer, consumer) = RingBuffer::new(capacity);
        (Self { producer, lost: 0 }, consumer)
    }

    /// Rows that found no room.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }
}

impl Rows for Queue {
    fn push(&mut self, row: Row) {
        self.lost += u64::from(self.producer.push(row).is_err());
    }
}

/// Takes every row until the loop's end of the queue is gone. `expected` makes room beforehand.
pub(crate) fn collect(mut consumer: Consumer<Row>, expected: usize) -> Vec<Row> {
    let mut rows = Vec::with_capacity(expected);
    loop {
        // Asked before the queue is emptied: what was put in before the end is then seen.
        let is_over = consumer.is_abandoned();
        while let Ok(row) = consumer.pop() {
            rows.push(row);
        }
        if is_over {
            return rows;
        }
        thread::sleep(NAP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(t_s: f64) -> Row {
        Row { t_s, ..Row::default() }
    }

    #[test]
    fn rows_come_out_in_order_and_all_of_them() {
        let (mut queue, consumer) = Queue::new();
        let collector = thread::spawn(|| collect(consumer, 10));
        for number in 0..100_000_u32 {
            while queue.producer.is_full() {
                thread::yield_now();
            }
            queue.push(row(f64::from(number)));
        }
        assert_eq!(queue.lost(), 0);
        drop(queue);
        let rows = collector.join().unwrap();
        assert_eq!(rows.len(), 100_000);
        assert!(rows.windows(2).all(|pair| pair[1].t_s == pair[0].t_s + 1.0));
    }

    #[test]
    fn a_full_queue_loses_rows_and_says_how_many() {
        let (mut queue, consumer) = Queue::with_capacity(4);
        (0..7_u32).for_each(|number| queue.push(row(f64::from(number))));
        assert_eq!(queue.lost(), 3);
        drop(queue);
        assert_eq!(collect(consumer, 0).len(), 4);
    }
}
