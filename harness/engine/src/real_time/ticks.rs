//! Measures the lateness of a target's ticks and counts missing ones.

use platebench_plate::Time;
use std::time::{Duration, Instant};

/// Measures lateness against the earliest recent tick, which counts as punctual. The time stamp of
/// a tick does not show lateness, because the target sets it when it handles the tick.
#[derive(Debug, Default)]
pub(super) struct TickTracker {
    first: Option<Instant>,
    last_us: u32,
    /// Time of the target since the first tick, without wrap, µs.
    target_us: u64,
    period: u64,
    /// Least delay of a tick after its period starts, µs, in this and the last `DRIFT_INTERVAL`.
    earliest: [Option<f64>; 2],
    interval: u64,
}

impl TickTracker {
    /// Two clocks drift apart by at most about 0.1 µs per ms, so by 50 µs in this interval.
    const DRIFT_INTERVAL: Duration = Duration::from_millis(500);

    pub(super) fn has_ticks(&self) -> bool {
        self.first.is_some()
    }

    /// Returns the lateness of the tick and the number of periods without a tick before it. If this
    /// tick is the earliest, the ticks before it were late, and their lateness is returned.
    pub(super) fn record(&mut self, at: Instant, target_us: u32, period: Time) -> (Duration, u64) {
        if self.first.is_none() {
            self.last_us = target_us;
        }
        let since = at.saturating_duration_since(*self.first.get_or_insert(at));
        let step = target_us.wrapping_sub(std::mem::replace(&mut self.last_us, target_us));
        // The counter wraps, so a step back looks like a step of more than half its range.
        self.target_us += if step > u32::MAX / 2 { 0 } else { u64::from(step) };
        let period_us = period.seconds() * 1e6;
        let number = (self.target_us as f64 / period_us).round();
        let before = std::mem::replace(&mut self.period, number as u64);
        let missing = self.period.saturating_sub(before + 1);

        let behind = since.as_secs_f64() * 1e6 - number * period_us;
        let interval = (since.as_nanos() / Self::DRIFT_INTERVAL.as_nanos()) as u64;
        if interval != self.interval {
            self.interval = interval;
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
    fn measures_lateness_against_punctual_ticks() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
            let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
            ticks.record(at, 0xFFFF_0000_u32.wrapping_add(target), PERIOD).0.as_micros()
        };
        assert_eq!(tick(0, 0), 0);
        assert!((299..=301).contains(&tick(1, 300)));
        assert!(tick(2, 0) <= 1);
        for number in 3..5_000 {
            let lateness = tick(number, 0);
            assert!(lateness <= 60, "tick {number}: drift of two intervals at most, not {lateness}");
        }
        let lateness = tick(5_000, 400);
        assert!((400..=460).contains(&lateness), "{lateness}");
    }

    #[test]
    fn a_late_first_tick_shows_in_the_second() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + late_us);
            ticks.record(at, number * 1_000, PERIOD).0.as_micros()
        };
        assert_eq!([tick(0, 900), tick(1, 500), tick(2, 0), tick(3, 0), tick(4, 10)], [0, 400, 500, 0, 10]);
    }

    #[test]
    fn counts_missing_ticks_across_the_wrap() {
        let mut ticks = TickTracker::default();
        let start = 0xFFFF_FF00_u32;
        let mut missing = |target_us: u32| ticks.record(Instant::now(), start.wrapping_add(target_us), PERIOD).1;
        assert_eq!([0, 1_000, 1_990, 3_000, 7_000, 8_499, 10_000].map(&mut missing), [0, 0, 0, 0, 3, 0, 1]);
        assert_eq!([9_000, 10_000].map(&mut missing), [0, 0], "the counter does not go back");
    }

    #[test]
    fn a_target_that_handles_its_tick_late_is_late() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u32| {
            let target_us = number * 1_000 + late_us;
            ticks.record(start + Duration::from_micros(target_us.into()), target_us, PERIOD).0.as_micros()
        };
        assert_eq!([tick(0, 0), tick(1, 220), tick(2, 0), tick(3, 450)], [0, 220, 0, 450]);
    }
}
