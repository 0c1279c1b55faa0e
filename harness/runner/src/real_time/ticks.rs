//! Control instants that a target's own timer makes.

use platebench_plate::Time;
use std::time::{Duration, Instant};

/// The target's ticks beside their arrivals: the earliest of late is taken for punctual.
///
/// A tick carries the instant at which the target came to it, so that a target which is late itself cannot be told by that: its periods are counted instead.
#[derive(Debug, Default)]
pub(super) struct Ticks {
    first: Option<Instant>,
    last_us: u32,
    /// On the target's clock since its first tick, µs, unwrapped.
    target_us: u64,
    /// Number of the last period.
    period: u64,
    /// Arrival minus the beginning of the period on the target's clock, µs, smallest of this stretch of time and of the one before: clocks drift.
    earliest: [Option<f64>; 2],
    stretch: u64,
}

impl Ticks {
    /// How long a stretch is; two clocks drift by some 0.1 µs in a millisecond at most.
    const STRETCH: Duration = Duration::from_millis(500);

    pub(super) fn any(&self) -> bool {
        self.first.is_some()
    }

    /// Takes in a tick that was heard `at`. How much later than usual that was within its period (or earlier: then the punctual ones before were late by as
    /// much), and how many periods went by without a tick since the last one.
    pub(super) fn hear(&mut self, at: Instant, target_us: u32, period: Time) -> (Duration, u64) {
        if self.first.is_none() {
            self.last_us = target_us;
        }
        let since = at.saturating_duration_since(*self.first.get_or_insert(at));
        let step = target_us.wrapping_sub(std::mem::replace(&mut self.last_us, target_us));
        // A clock that goes back looks an hour ahead.
        self.target_us += if step > u32::MAX / 2 { 0 } else { u64::from(step) };
        let period_us = period.seconds() * 1e6;
        let number = (self.target_us as f64 / period_us).round();
        let before = std::mem::replace(&mut self.period, number as u64);
        let missing = self.period.saturating_sub(before + 1);

        let behind = since.as_secs_f64() * 1e6 - number * period_us;
        let stretch = (since.as_nanos() / Self::STRETCH.as_nanos()) as u64;
        if stretch != self.stretch {
            self.stretch = stretch;
            self.earliest = [None, self.earliest[0]];
        }
        let earliest = self.earliest.iter().flatten().copied().reduce(f64::min).unwrap_or(behind);
        self.earliest[0] = Some(self.earliest[0].map_or(behind, |least| least.min(behind)));
        (Duration::from_secs_f64((behind - earliest).abs() / 1e6), missing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Time = Time::from_nanos(1_000_000);

    #[test]
    fn a_tick_is_late_against_the_punctual_ones_before_it() {
        let start = Instant::now();
        let mut ticks = Ticks::default();
        // The target's counter wraps in between and runs 50 ppm slow.
        let mut hear = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
            let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
            ticks.hear(at, 0xFFFF_0000_u32.wrapping_add(target), PERIOD).0.as_micros()
        };
        assert_eq!(hear(0, 0), 0);
        // The target counts whole microseconds.
        assert!((299..=301).contains(&hear(1, 300)));
        assert!(hear(2, 0) <= 1);
        for number in 3..5_000 {
            let lateness = hear(number, 0);
            assert!(lateness <= 60, "tick {number}: drift of two stretches at most, not {lateness}");
        }
        let lateness = hear(5_000, 400);
        assert!((400..=460).contains(&lateness), "{lateness}");
    }

    #[test]
    fn a_first_tick_that_was_late_shows_in_the_second() {
        let start = Instant::now();
        let mut ticks = Ticks::default();
        let mut hear = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + late_us);
            ticks.hear(at, number * 1_000, PERIOD).0.as_micros()
        };
        assert_eq!([hear(0, 900), hear(1, 500), hear(2, 0), hear(3, 0), hear(4, 10)], [0, 400, 500, 0, 10]);
    }

    #[test]
    fn periods_without_a_tick_are_counted_across_the_wrap() {
        let mut ticks = Ticks::default();
        let start = 0xFFFF_FF00_u32;
        let mut missing = |target_us: u32| ticks.hear(Instant::now(), start.wrapping_add(target_us), PERIOD).1;
        assert_eq!([0, 1_000, 1_990, 3_000, 7_000, 8_499, 10_000].map(&mut missing), [0, 0, 0, 0, 3, 0, 1]);
        assert_eq!([9_000, 10_000].map(&mut missing), [0, 0], "never back");
    }

    #[test]
    fn a_target_that_comes_late_to_its_own_tick_is_late() {
        let start = Instant::now();
        let mut ticks = Ticks::default();
        let mut hear = |number: u32, late_us: u32| {
            let target_us = number * 1_000 + late_us;
            ticks.hear(start + Duration::from_micros(target_us.into()), target_us, PERIOD).0.as_micros()
        };
        assert_eq!([hear(0, 0), hear(1, 220), hear(2, 0), hear(3, 450)], [0, 220, 0, 450]);
    }
}
