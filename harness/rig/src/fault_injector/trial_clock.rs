//! Converts wall instants to trial time and back.

use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy)]
pub(super) struct TrialClock {
    pub(super) start: Instant,
    /// Trial seconds per wall second.
    pub(super) scale: f64,
}

/// Longer than any trial, and short enough to be added to any instant.
const MAX_TRIAL_DURATION: Duration = Duration::from_secs(1 << 30);

impl TrialClock {
    pub(super) fn trial_time(&self, instant: Instant) -> Duration {
        bounded_duration(instant.saturating_duration_since(self.start).as_secs_f64() * self.scale)
    }

    pub(super) fn wall_instant(&self, time: Duration) -> Instant {
        self.start + bounded_duration(time.as_secs_f64() / self.scale)
    }
}

fn bounded_duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or(MAX_TRIAL_DURATION).min(MAX_TRIAL_DURATION)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn converts_both_ways_without_overflow() {
        let (start, ms) = (Instant::now(), Duration::from_millis);
        let clock = TrialClock { start, scale: 10.0 };
        assert_eq!((clock.trial_time(start + ms(20)), clock.wall_instant(ms(200))), (ms(200), start + ms(20)));
        assert_eq!(clock.trial_time(start.checked_sub(ms(20)).unwrap()), Duration::ZERO);
        let still = TrialClock { start, scale: f64::MIN_POSITIVE };
        assert!(still.wall_instant(Duration::MAX) > start && clock.wall_instant(Duration::MAX) > start);
    }
}
