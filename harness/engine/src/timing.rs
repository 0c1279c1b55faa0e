//! Keeps the time of a loop in real time: conversion between plate time and wall time, timing
//! statistics without allocation, real-time scheduling.

use hdrhistogram::Histogram;
use platebench_model::record::{Quantiles, TimingRecord};
use platebench_plate::Time;
use platebench_wire::Configure;
use rustix::mm::{MlockAllFlags, mlockall, munlockall};
use std::time::Duration;
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

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
    pub(crate) fn with_target_timing(&self, configure: Configure) -> Configure {
        let period = Duration::from_micros(u64::from(configure.period_us)).as_secs_f64();
        // 0 keeps the controller's default of five control periods.
        let watchdog_ms = if self.time_scale == 1.0 { 0.0 } else { (5.0 * period * 1e3 / self.time_scale).ceil() };
        let paced_by_target = self.pacing == Pacing::Target;
        Configure { watchdog_timeout_ms: watchdog_ms as u16, paced_by_target, ..configure }
    }
}

/// Longest recorded duration, 1 min. A longer duration is clamped to it.
const MAX_DURATION_NS: u64 = 60_000_000_000;

pub(crate) struct DurationHistogram(Histogram<u64>);

impl Default for DurationHistogram {
    fn default() -> Self {
        let histogram = Histogram::new_with_bounds(1, MAX_DURATION_NS, 3);
        Self(histogram.unwrap_or_else(|_| unreachable!()))
    }
}

impl DurationHistogram {
    pub(crate) fn record(&mut self, span: Duration) {
        self.0.saturating_record(u64::try_from(span.as_nanos()).unwrap_or(u64::MAX).max(1));
    }

    pub(crate) fn quantiles_us(&self) -> Option<Quantiles> {
        let at = |share: f64| self.0.value_at_quantile(share) as f64 / 1e3;
        (!self.0.is_empty()).then(|| Quantiles {
            p50: at(0.5),
            p99: at(0.99),
            p999: at(0.999),
            max: self.0.max() as f64 / 1e3,
        })
    }
}

/// Fits the drift of the target's clock by least squares over the samples. Occasional delays
/// increase the standard error. A delay that grows steadily looks like drift.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ClockDrift {
    last_target_us: Option<u32>,
    target_us: f64,
    count: f64,
    mean_bench: f64,
    mean_ahead: f64,
    square_bench: f64,
    product: f64,
    square_ahead: f64,
}

impl ClockDrift {
    /// `target_us` is the target's time of the same event. Its counter wraps.
    pub(crate) fn record(&mut self, bench: Duration, target_us: u32) {
        let step = self.last_target_us.replace(target_us).map_or(0, |last| target_us.wrapping_sub(last));
        self.target_us += f64::from(step);
        let bench_us = bench.as_secs_f64() * 1e6;
        let ahead = self.target_us - bench_us;
        self.count += 1.0;
        let (from_bench, from_ahead) = (bench_us - self.mean_bench, ahead - self.mean_ahead);
        self.mean_bench += from_bench / self.count;
        self.mean_ahead += from_ahead / self.count;
        self.square_bench += from_bench * (bench_us - self.mean_bench);
        self.product += from_bench * (ahead - self.mean_ahead);
        self.square_ahead += from_ahead * (ahead - self.mean_ahead);
    }

    /// Drift and standard error, ppm, positive if the target is fast. `None` below three samples.
    pub(crate) fn ppm(&self) -> Option<(f64, f64)> {
        if self.count < 3.0 || self.square_bench <= 0.0 {
            return None;
        }
        let slope = self.product / self.square_bench;
        let residual = (self.square_ahead - slope * self.product).max(0.0) / (self.count - 2.0);
        Some((slope * 1e6, (residual / self.square_bench).sqrt() * 1e6))
    }
}

#[derive(Default)]
pub(crate) struct TimingStats {
    /// Only its counts are used. [`TimingStats::timing`] adds the other values.
    pub(crate) counts: TimingRecord,
    pub(crate) lateness: DurationHistogram,
    /// Time from sample to command, in plate time.
    pub(crate) loop_delay: DurationHistogram,
    /// Longest time from sample to command, in wall time.
    pub(crate) longest_rig_delay: Duration,
    pub(crate) drift: ClockDrift,
}

impl TimingStats {
    pub(crate) fn timing(&self) -> TimingRecord {
        let drift = self.drift.ppm();
        TimingRecord {
            lateness_us: self.lateness.quantiles_us().unwrap_or_default(),
            loop_delay_us: self.loop_delay.quantiles_us(),
            target_clock_ppm: drift.map(|(ppm, _)| ppm),
            target_clock_error_ppm: drift.map(|(_, error)| error),
            ..self.counts.clone()
        }
    }
}

/// Priority below the kernel's interrupt threads, which have 50 and serve the serial line.
const RT_PRIORITY: u8 = 45;

/// The scheduling class lasts until the thread ends, the memory lock until this value is dropped.
#[derive(Debug, Clone)]
pub(crate) struct ThreadScheduling {
    /// Scheduling class, with the reason if it is not `SCHED_FIFO`.
    pub(crate) scheduling: String,
    pub(crate) memory_locked: bool,
}

impl ThreadScheduling {
    pub(crate) fn request() -> Self {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let outcome = ThreadPriorityValue::try_from(RT_PRIORITY).and_then(|priority| {
            let priority = ThreadPriority::Crossplatform(priority);
            set_thread_priority_and_policy(thread_native_id(), priority, policy).map_err(|error| error.to_string())
        });
        let scheduling = match outcome {
            Ok(()) => "SCHED_FIFO".to_owned(),
            Err(why) => format!("SCHED_OTHER, because SCHED_FIFO was not granted: {why}"),
        };
        let memory_locked = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).is_ok();
        Self { scheduling, memory_locked }
    }
}

impl Drop for ThreadScheduling {
    fn drop(&mut self) {
        if self.memory_locked {
            let _ = munlockall();
        }
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

    #[test]
    fn quantiles_match_the_values() {
        let mut spans = DurationHistogram::default();
        assert_eq!(spans.quantiles_us(), None);
        (1..=1000).for_each(|micros| spans.record(Duration::from_micros(micros)));
        let found = spans.quantiles_us().unwrap();
        for (value, expected) in [(found.p50, 500.0), (found.p99, 990.0), (found.p999, 999.0), (found.max, 1000.0)] {
            assert!((value / expected - 1.0).abs() < 2e-3, "{value}, expected {expected}");
        }
        spans.record(Duration::from_hours(1));
        assert!((spans.quantiles_us().unwrap().max / 60e6 - 1.0).abs() < 2e-3, "values beyond the range are clamped");
    }

    fn drift(offset_us: f64, ppm: f64, jitter_us: f64, count: u32) -> ClockDrift {
        let mut drift = ClockDrift::default();
        for number in 0..count {
            let bench = Duration::from_millis(u64::from(number));
            let late = if number % 2 == 0 { 0.0 } else { jitter_us };
            let target = offset_us + (bench.as_secs_f64() * 1e6 + late) * (1.0 + ppm * 1e-6);
            drift.record(bench, (target.round() as u64) as u32);
        }
        drift
    }

    #[test]
    fn finds_the_drift_across_the_wrap() {
        for ppm in [-80.0, 0.0, 40.0] {
            let (found, error) = drift(4_294_967_296.0 - 5e6, ppm, 30.0, 10_000).ppm().unwrap();
            assert!((found - ppm).abs() < 4.0 * error.max(0.01), "{found} ± {error}, expected {ppm}");
            assert!(error < 0.1, "{error}");
        }
    }

    #[test]
    fn jitter_widens_the_standard_error() {
        let quiet = drift(0.0, 10.0, 0.0, 1_000).ppm().unwrap().1;
        let noisy = drift(0.0, 10.0, 100.0, 1_000).ppm().unwrap().1;
        assert!(noisy > 10.0 * quiet, "{quiet} {noisy}");
        assert_eq!(drift(0.0, 0.0, 0.0, 2).ppm(), None);
    }
}
