//! Passes rows out of a loop that must not wait, through a bounded queue without locks.

use crate::plant_simulation::RowSink;
use platebench_model::trace::Row;
use rtrb::{Consumer, Producer, RingBuffer};
use std::thread;
use std::time::Duration;

/// Number of rows, more than 1 s at a trace step of 0.05 ms and a control period of 1 ms.
const CAPACITY: usize = 1 << 15;
/// Time between two reads. To fill the queue takes hundreds of times longer.
const POLL_INTERVAL: Duration = Duration::from_millis(2);

pub(crate) struct RowQueue {
    producer: Producer<Row>,
    lost_rows: u64,
}

impl RowQueue {
    pub(crate) fn new() -> (Self, Consumer<Row>) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, Consumer<Row>) {
        let (producer, consumer) = RingBuffer::new(capacity);
        (Self { producer, lost_rows: 0 }, consumer)
    }

    pub(crate) fn lost(&self) -> u64 {
        self.lost_rows
    }
}

impl RowSink for RowQueue {
    fn push(&mut self, row: Row) {
        self.lost_rows += u64::from(self.producer.push(row).is_err());
    }
}

/// Collects rows until the producer is dropped. Allocates memory for `expected` rows at the start.
pub(crate) fn collect_rows(consumer: Consumer<Row>, expected: usize) -> Vec<Row> {
    watch_rows(consumer, Vec::with_capacity(expected), POLL_INTERVAL, |_| {})
}

/// Appends to `rows` until the producer is dropped. Calls `watch` with all rows after each read.
pub(crate) fn watch_rows(
    mut consumer: Consumer<Row>,
    mut rows: Vec<Row>,
    interval: Duration,
    mut watch: impl FnMut(&[Row]),
) -> Vec<Row> {
    loop {
        // Checked before the queue is emptied. Otherwise rows that arrive in between would be lost.
        let is_over = consumer.is_abandoned();
        while let Ok(row) = consumer.pop() {
            rows.push(row);
        }
        watch(&rows);
        if is_over {
            return rows;
        }
        thread::sleep(interval);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(t_s: f64) -> Row {
        Row { t_s, ..Row::default() }
    }

    #[test]
    fn returns_all_rows_in_order() {
        let (mut queue, consumer) = RowQueue::new();
        let collector = thread::spawn(|| collect_rows(consumer, 10));
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
    fn a_full_queue_counts_the_rows_it_loses() {
        let (mut queue, consumer) = RowQueue::with_capacity(4);
        (0..7_u32).for_each(|number| queue.push(row(f64::from(number))));
        assert_eq!(queue.lost(), 3);
        drop(queue);
        assert_eq!(collect_rows(consumer, 0).len(), 4);
    }
}
