//! Compares the number and the send times of a controller's ticks with those of the reference.

use platebench_wire::{Configure, Message, Packet};
use std::time::Duration;

/// Largest difference between the clocks of controller and bench.
const CLOCK_MARGIN: Duration = Duration::from_millis(50);
const MIN_TICKS: usize = 100;
/// The drift of a quarter of the ticks is their tenth percentile, because even a busy host sends
/// one tick in ten in time.
const IN_TIME_DIVISOR: usize = 10;
/// Largest permitted drift, as a share of the period.
const DRIFT_SHARE: f64 = 0.25;

#[derive(Debug, Default)]
pub(super) struct TickComparison {
    period: Duration,
    expected: usize,
    /// Lateness of the bench, by which the controller may be ahead of the reference.
    late: Duration,
    /// Send time of each tick on the controller's clock, µs.
    sent_us: Vec<u32>,
}

impl TickComparison {
    pub(super) fn new(configure: &Configure) -> Self {
        Self { period: Duration::from_micros(configure.period_us.into()), ..Self::default() }
    }

    /// Adds the ticks of one exchange. `expected` is the number of ticks of the reference, `late`
    /// the bench's lateness. Returns a sentence if a number is wrong.
    pub(super) fn add(&mut self, ticks: &[Packet], expected: usize, late: Duration) -> Option<String> {
        self.expected += expected;
        self.late += late;
        for tick in ticks {
            let Message::Tick(message) = tick.message else { continue };
            self.sent_us.push(message.target_time_us);
            let number = self.sent_us.len() as u8;
            if tick.sequence != number {
                return Some(format!("tick {}, expected tick {number}", tick.sequence));
            }
        }
        let own = self.sent_us.len();
        let count = |time: Duration| time.div_duration_f64(self.period).max(1.0) as usize;
        let (fewer, more) =
            if self.expected == 0 { (0, 0) } else { (count(CLOCK_MARGIN), count(CLOCK_MARGIN + self.late)) };
        let is_far = own + fewer < self.expected || own > self.expected + more;
        is_far.then(|| format!("{own} ticks since the configuration, expected {}", self.expected))
    }

    /// Returns the drift from the first to the last quarter if it exceeds [`DRIFT_SHARE`].
    pub(super) fn drift(&self) -> Option<Duration> {
        if self.sent_us.len() < MIN_TICKS {
            return None;
        }
        let period_us = self.period.as_secs_f64() * 1e6;
        let mut drift_us = 0.0;
        let advances = self.sent_us.array_windows().map(|[previous, tick]| f64::from(tick.wrapping_sub(*previous)));
        let drifts: Vec<f64> = advances
            .map(|advance_us| {
                drift_us += advance_us - (advance_us / period_us).round() * period_us;
                drift_us
            })
            .collect();
        let quarter = drifts.len() / 4;
        let in_time = |drifts: &[f64]| {
            let mut sorted = drifts.to_vec();
            sorted.sort_by(f64::total_cmp);
            sorted.get(sorted.len() / IN_TIME_DIVISOR).copied()
        };
        let (first, last) = (in_time(drifts.get(..quarter)?)?, in_time(drifts.get(drifts.len() - quarter..)?)?);
        let drift_us = (last - first).abs();
        (drift_us > DRIFT_SHARE * period_us).then(|| Duration::from_secs_f64(drift_us * 1e-6))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_test_kit::CONFIGURE;
    use platebench_wire::Tick;
    use rstest::rstest;

    /// Returns ticks with a period of 5 ms plus `drift_us`, each sent `late_us` after its due time.
    fn ticks(count: u32, late_us: impl Fn(u32) -> u32, drift_us: u32) -> Vec<Packet> {
        let start_us = u32::MAX - 100_000;
        let sent_us = |number: u32| start_us.wrapping_add(number * (5_000 + drift_us) + late_us(number));
        let packet = |number| {
            let message = Message::Tick(Tick { target_time_us: sent_us(number) });
            Packet { sequence: (number + 1) as u8, message }
        };
        (0..count).map(packet).collect()
    }

    fn comparison() -> TickComparison {
        TickComparison::new(&Configure { period_us: 5_000, ..CONFIGURE })
    }

    #[rstest]
    #[case::in_time(180, 0, 0, false)]
    #[case::most_are_late(180, 4_900, 0, false)]
    #[case::just_too_little(180, 0, 9, false)]
    #[case::just_enough(180, 0, 10, true)]
    #[case::too_few(99, 0, 60, false)]
    fn drift_is_not_lateness(#[case] count: u32, #[case] late_us: u32, #[case] drift_us: u32, #[case] is_found: bool) {
        let mut ticks_of_controller = comparison();
        let late = |number: u32| if number.is_multiple_of(7) { 0 } else { late_us };
        assert_eq!(ticks_of_controller.add(&ticks(count, late, drift_us), count as usize, Duration::ZERO), None);
        assert_eq!(ticks_of_controller.drift().is_some(), is_found);
    }

    #[rstest]
    #[case::equal(180, 0, None)]
    #[case::at_most_50_ms_apart(170, 0, None)]
    #[case::too_few(169, 0, Some("169 ticks since the configuration, expected 180"))]
    #[case::too_many(191, 0, Some("191 ticks since the configuration, expected 180"))]
    #[case::a_late_bench(191, 5, None)]
    #[case::a_late_bench_explains_no_missing_ticks(169, 5, Some("169 ticks since the configuration, expected 180"))]
    fn their_number_is_compared(#[case] count: u32, #[case] late_ms: u64, #[case] text: Option<&str>) {
        let late = Duration::from_millis(late_ms);
        assert_eq!(comparison().add(&ticks(count, |_| 0, 0), 180, late).as_deref(), text);
    }

    #[test]
    fn without_ticks_of_the_reference_one_is_too_many() {
        let text = "1 ticks since the configuration, expected 0";
        assert_eq!(comparison().add(&ticks(1, |_| 0, 0), 0, Duration::from_secs(1)).as_deref(), Some(text));
    }

    #[test]
    fn a_skipped_number_is_wrong() {
        let mut ticks = ticks(3, |_| 0, 0);
        ticks.remove(1);
        assert_eq!(comparison().add(&ticks, 2, Duration::ZERO).as_deref(), Some("tick 3, expected tick 2"));
    }
}
