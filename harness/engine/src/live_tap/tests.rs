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
    let rows: Vec<_> = (0..100).map(|number| row(f64::from(number), 3.0, Flags::CONTROL | Flags::OVERRUN)).collect();
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
