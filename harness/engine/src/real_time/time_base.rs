//! Converts between plate time and wall time.

use platebench_plate::Time;
use platebench_wire::Configure;
use std::time::Duration;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pacing {
    /// A sample from the bench triggers each control step.
    #[default]
    Bench,
    /// A tick from the target requests each sample.
    Target,
}

impl Pacing {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bench => "bench",
            Self::Target => "target",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeBase {
    /// Seconds of plate time per second of wall time, above 0.
    pub time_scale: f64,
    pub pacing: Pacing,
}

impl TimeBase {
    pub fn wall_duration(&self, span: Time) -> Duration {
        Duration::from_nanos((span.as_nanos() as f64 / self.time_scale).round() as u64)
    }

    pub fn plate_time(&self, span: Duration) -> Time {
        Time::from_nanos((span.as_nanos() as f64 * self.time_scale).round() as u64)
    }

    /// Sets the pacing and the watchdog, which runs in wall time.
    pub(super) fn with_target_timing(&self, configure: Configure) -> Configure {
        let period = Duration::from_micros(u64::from(configure.period_us)).as_secs_f64();
        // 0 keeps the controller's default of five control periods.
        let watchdog_ms = if self.time_scale == 1.0 { 0.0 } else { (5.0 * period * 1e3 / self.time_scale).ceil() };
        let paced_by_target = self.pacing == Pacing::Target;
        Configure { watchdog_timeout_ms: watchdog_ms as u16, paced_by_target, ..configure }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_test_kit::CONFIGURE;

    #[test]
    fn time_scale_relates_plate_and_wall() {
        let base = |time_scale| TimeBase { time_scale, pacing: Pacing::Bench };
        let period = Time::from_nanos(1_000_000);
        assert_eq!(base(1.0).wall_duration(period), Duration::from_millis(1));
        assert_eq!(base(0.1).wall_duration(period), Duration::from_millis(10));
        assert_eq!(base(0.1).plate_time(Duration::from_millis(10)), period);
        let long = Time::from_nanos(3 * 3_600_000_000_000 + 1);
        assert_eq!(base(1.0).plate_time(base(1.0).wall_duration(long)), long);
    }

    #[test]
    fn the_watchdog_runs_in_wall_time() {
        let with_timing = |time_scale, pacing| TimeBase { time_scale, pacing }.with_target_timing(CONFIGURE);
        assert_eq!(with_timing(1.0, Pacing::Bench).watchdog_timeout_ms, 0);
        assert_eq!(with_timing(0.1, Pacing::Bench).watchdog_timeout_ms, 50);
        assert_eq!(with_timing(0.3, Pacing::Bench).watchdog_timeout_ms, 17);
        assert!(!with_timing(1.0, Pacing::Bench).paced_by_target && with_timing(1.0, Pacing::Target).paced_by_target);
    }
}
