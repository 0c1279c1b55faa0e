//! How plate time passes on the wall's clock, and what the controller is told of it.

use platebench_plate::Time;
use platebench_wire::Configure;
use std::time::Duration;

/// Whose timer makes the control instants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pacing {
    /// The bench's: a sample triggers a control step.
    #[default]
    Bench,
    /// The target's: its tick asks for a sample.
    Target,
}

impl Pacing {
    /// The name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bench => "bench",
            Self::Target => "target",
        }
    }
}

/// How plate time passes on the wall's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// Plate seconds per wall second, above 0.
    pub time_scale: f64,
    /// Whose timer makes the control instants.
    pub pacing: Pacing,
}

impl Pace {
    /// How long `span` of plate time takes on the wall.
    pub fn wall(&self, span: Time) -> Duration {
        Duration::from_nanos((span.as_nanos() as f64 / self.time_scale).round() as u64)
    }

    /// How much plate time passes in `span`.
    pub fn plate(&self, span: Duration) -> Time {
        Time::from_nanos((span.as_nanos() as f64 * self.time_scale).round() as u64)
    }

    /// What the controller is told of its own clock.
    pub(super) fn of_target(&self, configure: Configure) -> Configure {
        let period = Duration::from_micros(u64::from(configure.period_us)).as_secs_f64();
        // Five periods are the controller's own choice where plate and wall agree.
        let patience_ms = if self.time_scale == 1.0 { 0.0 } else { (5.0 * period * 1e3 / self.time_scale).ceil() };
        let paced_by_target = self.pacing == Pacing::Target;
        Configure { patience_ms: patience_ms as u16, paced_by_target, ..configure }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plate_and_wall_are_the_same_at_a_scale_of_one_and_apart_otherwise() {
        let pace = |time_scale| Pace { time_scale, pacing: Pacing::Bench };
        let period = Time::from_nanos(1_000_000);
        assert_eq!(pace(1.0).wall(period), Duration::from_millis(1));
        assert_eq!(pace(0.1).wall(period), Duration::from_millis(10));
        assert_eq!(pace(0.1).plate(Duration::from_millis(10)), period);
        // Three hours, to the nanosecond.
        let long = Time::from_nanos(3 * 3_600_000_000_000 + 1);
        assert_eq!(pace(1.0).plate(pace(1.0).wall(long)), long);
    }

    #[test]
    fn a_controller_is_given_patience_in_wall_time() {
        let configure = Configure {
            law: platebench_wire::LawId::DqPi,
            paced_by_target: false,
            drives_own_plate: false,
            patience_ms: 0,
            period_us: 1_000,
            loop_delay_us: 0,
            start_frequency_mhz: 32_307_600,
            gain_um_per_vpp: 0.00698,
            time_constant_s: 1.88e-3,
            response_time_s: 0.0,
            drive_limit_vpp: 900.0,
            frequency_range_hz: 250.0,
            frequency_slew_hz: 100.0,
            gains: None,
        };
        let told = |time_scale, pacing| Pace { time_scale, pacing }.of_target(configure);
        assert_eq!(told(1.0, Pacing::Bench).patience_ms, 0);
        assert_eq!(told(0.1, Pacing::Bench).patience_ms, 50);
        assert_eq!(told(0.3, Pacing::Bench).patience_ms, 17);
        assert!(!told(1.0, Pacing::Bench).paced_by_target && told(1.0, Pacing::Target).paced_by_target);
    }
}
