//! Represents instants and spans of plate time in integer nanoseconds.

use std::fmt;
use std::ops::{Add, Sub};
use std::time::Duration;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Time(u64);

/// Largest time, 104 days. Up to it an f64 represents every nanosecond.
const LARGEST_NS: u64 = 1 << 53;

impl Time {
    pub const ZERO: Self = Self(0);

    pub const fn from_nanos(nanos: u64) -> Self {
        Self(nanos)
    }

    /// Rounded to 1 ns; `None` if negative, not finite or above 104 days.
    pub fn from_ms(ms: f64) -> Option<Self> {
        Self::from_scaled(ms, 1e6)
    }

    /// Rounded to 1 ns; `None` if negative, not finite or above 104 days.
    pub fn from_seconds(seconds: f64) -> Option<Self> {
        Self::from_scaled(seconds, 1e9)
    }

    fn from_scaled(value: f64, nanos_per_unit: f64) -> Option<Self> {
        let nanos = (value * nanos_per_unit).round();
        (nanos >= 0.0 && nanos <= LARGEST_NS as f64).then_some(Self(nanos as u64))
    }

    pub const fn as_nanos(self) -> u64 {
        self.0
    }

    /// Time stamp as in the protocol: whole µs, modulo 2³².
    pub const fn wrapping_micros(self) -> u32 {
        (self.0 / 1000) as u32
    }

    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e9
    }

    pub fn ms(self) -> f64 {
        self.0 as f64 / 1e6
    }

    /// Time since `earlier`; zero if `earlier` is later than `self`.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Self {
        Self(self.0.saturating_sub(earlier.0))
    }

    #[must_use]
    pub const fn midpoint(self, later: Self) -> Self {
        Self(u64::midpoint(self.0, later.0))
    }

    #[must_use]
    pub const fn times(self, count: u64) -> Self {
        Self(self.0.saturating_mul(count))
    }

    /// First multiple of `self` after `instant`; the largest time if `self` is zero.
    #[must_use]
    pub const fn next_multiple_after(self, instant: Self) -> Self {
        match instant.0.checked_div(self.0) {
            Some(whole) => self.times(whole + 1),
            None => Self(u64::MAX),
        }
    }
}

impl Add for Time {
    type Output = Self;

    fn add(self, span: Self) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub for Time {
    type Output = Self;

    fn sub(self, earlier: Self) -> Self {
        self.since(earlier)
    }
}

impl From<Time> for Duration {
    fn from(time: Time) -> Self {
        Self::from_nanos(time.0)
    }
}

impl fmt::Display for Time {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} ms", self.ms())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milliseconds_round_to_the_nearest_nanosecond() {
        assert_eq!(Time::from_ms(0.05).map(Time::as_nanos), Some(50_000));
        assert_eq!(Time::from_ms(1e-6).map(Time::as_nanos), Some(1));
        assert_eq!(Time::from_ms(4.9e-7).map(Time::as_nanos), Some(0));
        assert_eq!(Time::from_ms(-1e-5), None);
        assert_eq!(Time::from_ms(f64::NAN), None);
        assert_eq!(Time::from_ms(f64::INFINITY), None);
    }

    #[test]
    fn refuses_times_above_104_days() {
        assert!(Time::from_seconds(9_007_199.0).is_some());
        assert!(Time::from_seconds(9_007_200.0).is_none());
    }

    #[test]
    fn seconds_print_in_their_shortest_form() {
        for (ms, text) in [(1.05, "0.00105"), (60_000.05, "60.00005"), (0.3, "0.0003")] {
            assert_eq!(Time::from_ms(ms).unwrap().seconds().to_string(), text);
        }
    }

    #[test]
    fn the_next_multiple_is_strictly_later() {
        let step = Time::from_nanos(50);
        assert_eq!(step.next_multiple_after(Time::from_nanos(49)).as_nanos(), 50);
        assert_eq!(step.next_multiple_after(Time::from_nanos(50)).as_nanos(), 100);
        assert_eq!(Time::ZERO.next_multiple_after(Time::ZERO).as_nanos(), u64::MAX);
    }
}
