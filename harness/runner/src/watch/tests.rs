use super::*;
use allocation_counter::{AllocationInfo, measure};

fn row(t_s: f64, lateness_us: f64, flags: Flags) -> Row {
    Row { t_s, lateness_us, flags, ..Row::default() }
}

fn pushed(watch: &Watch, rows: &[Row]) {
    let mut lent = watch.lend(0, 0);
    for row in rows {
        lent.tap().unwrap().push(row);
    }
}

#[test]
fn rows_come_out_in_order_with_the_trial_that_they_are_of() {
    let (watch, mut viewer) = Watch::with_capacity(8);
    for (scenario, trial) in [(0, 0), (2, 7)] {
        let mut lent = watch.lend(scenario, trial);
        for t_s in [0.0, 1.0] {
            lent.tap().unwrap().push(&row(t_s, 0.0, Flags::empty()));
        }
    }
    let seen: Vec<_> =
        std::iter::from_fn(|| viewer.take()).map(|sight| (sight.scenario, sight.trial, sight.row.t_s)).collect();
    assert_eq!(seen, [(0, 0, 0.0), (0, 0, 1.0), (2, 7, 0.0), (2, 7, 1.0)]);
}

#[test]
fn a_queue_that_nobody_reads_loses_rows_but_no_count() {
    let (watch, viewer) = Watch::with_capacity(4);
    let rows: Vec<_> = (0..100).map(|number| row(f64::from(number), 3.0, Flags::CONTROL | Flags::OVERRUN)).collect();
    pushed(&watch, &rows);
    let counts = viewer.counts();
    assert_eq!((counts.rows, counts.dropped, counts.overruns, counts.lateness[2]), (100, 96, 100, 100));
}

#[test]
fn a_push_allocates_nothing_whether_there_is_room_or_not() {
    let (watch, mut viewer) = Watch::with_capacity(16);
    let mut lent = watch.lend(0, 0);
    let tap = lent.tap().unwrap();
    let row = row(0.0, 1e9, Flags::CONTROL);
    for room in [true, false] {
        let allocated = measure(|| (0..16).for_each(|_| tap.push(&row)));
        assert_eq!(allocated, AllocationInfo::default(), "room: {room}");
    }
    assert_eq!(viewer.counts().dropped, 16);
    assert!(viewer.take().is_some());
}

#[test]
fn classes_of_lateness_are_powers_of_two_and_every_value_has_one() {
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
        assert_eq!(class(lateness_us), expected, "{lateness_us} µs");
    }
}

#[test]
fn lateness_is_that_of_control_instants_alone() {
    let (watch, viewer) = Watch::with_capacity(8);
    // Between instants, at one, at one that was skipped.
    pushed(&watch, &[Flags::empty(), Flags::CONTROL, Flags::OVERRUN].map(|flags| row(0.0, 0.5, flags)));
    assert_eq!(viewer.counts().lateness.iter().sum::<u64>(), 2);
}

#[test]
fn refused_frames_add_up_over_trials_that_count_from_zero_each() {
    let (watch, viewer) = Watch::with_capacity(8);
    for so_far in [[1, 3], [0, 2]] {
        let mut lent = watch.lend(0, 0);
        for count in so_far {
            lent.tap().unwrap().refused(count);
        }
    }
    assert_eq!(viewer.counts().refused, 5);
}

#[test]
fn one_trial_at_a_time_is_looked_at_and_the_next_one_after_it() {
    let (watch, _viewer) = Watch::with_capacity(8);
    let mut first = watch.lend(0, 0);
    assert!(first.tap().is_some());
    assert!(watch.lend(0, 1).tap().is_none(), "the other one is being looked at");
    drop(first);
    assert!(watch.lend(0, 2).tap().is_some());
    assert!(Watch::default().lend(0, 0).tap().is_none(), "nobody looks");
}
