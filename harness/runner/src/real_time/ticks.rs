//! Control instants that a target's own timer makes.

use platebench_plate::Time;
use std::time::{Duration, Instant};

/// The target's ticks beside their arrivals: the earliest of late is taken for punctual.
#[derive(Debug, Default)]
pub(super) struct Ticks {
    first: Option<(Instant, u32)>,
    last_us: Option<u32>,
    /// Arrival minus the target's time, µs, smallest of this stretch of time and of the one before: clocks drift.
    earliest: [Option<f64>; 2],
    stretch: u64,
}

impl Ticks {
    /// How long a stretch is; two clocks drift by some 0.1 µs in a millisecond at most.
    const STRETCH: Duration = Duration::from_millis(500);

    pub(super) fn any(&self) -> bool {
        self.first.is_some()
    }

    /// How many periods the target let pass since its last tick: instants at which nobody controlled.
    pub(super) fn missing(&mut self, target_us: u32, period: Time) -> u64 {
        let last = self.last_us.replace(target_us).unwrap_or(target_us);
        let since = f64::from(target_us.wrapping_sub(last)) / 1e6;
        // One that says its last instant again looks an hour away.
        let periods =
            if target_us.wrapping_sub(last) > u32::MAX / 2 { 0.0 } else { (since / period.seconds()).round() };
        (periods as u64).saturating_sub(1)
    }

    /// How much later than usual after its own instant this tick was heard; where it was earlier, the punctual ones before were late by as much.
    pub(super) fn lateness(&mut self, at: Instant, target_us: u32) -> Duration {
        let (first_at, first_us) = *self.first.get_or_insert((at, target_us));
        let since = at.saturating_duration_since(first_at);
        // Wraps after 71 minutes together with the target's counter.
        let bench_us = (since.as_micros() as u32).wrapping_sub(target_us.wrapping_sub(first_us)).cast_signed();
        let behind = f64::from(bench_us);
        let stretch = (since.as_nanos() / Self::STRETCH.as_nanos()) as u64;
        if stretch != self.stretch {
            self.stretch = stretch;
            self.earliest = [None, self.earliest[0]];
        }
        let earliest = self.earliest.iter().flatten().copied().reduce(f64::min).unwrap_or(behind);
        self.earliest[0] = Some(self.earliest[0].map_or(behind, |least| least.min(behind)));
        Duration::from_secs_f64((behind - earliest).abs() / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tick_is_late_against_the_punctual_ones_before_it() {
        let start = Instant::now();
        let mut ticks = Ticks::default();
        // The target's counter wraps in between and runs 50 ppm slow.
        let mut hear = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
            let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
            ticks.lateness(at, 0xFFFF_0000_u32.wrapping_add(target)).as_micros()
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
            ticks.lateness(at, number * 1_000).as_micros()
        };
        assert_eq!([hear(0, 900), hear(1, 500), hear(2, 0), hear(3, 0), hear(4, 10)], [0, 400, 500, 0, 10]);
    }

    #[test]
    fn periods_without_a_tick_are_counted_across_the_wrap() {
        let mut ticks = Ticks::default();
        let period = Time::from_nanos(1_000_000);
        let start = 0xFFFF_FF00_u32;
        let mut missing = |target_us: u32| ticks.missing(start.wrapping_add(target_us), period);
        assert_eq!([0, 1_000, 1_990, 3_000, 7_000, 8_499, 10_000].map(&mut missing), [0, 0, 0, 0, 3, 0, 1]);
        assert_eq!([9_000, 10_000].map(&mut missing), [0, 0], "never back");
    }
}
