//! Collects the timing of a real-time loop without allocating.

use hdrhistogram::Histogram;
use platebench_model::record::{Quantiles, TimingRecord};
use std::time::Duration;

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

#[cfg(test)]
mod tests {
    use super::*;

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
