//! Decides whether a trial on the simulated plate counts.

use platebench_model::record::{Exclusion, Telemetry};
use platebench_model::scenario::{Metric, Scenario};
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;

/// Twice the error of an on-chip oscillator, 1 %. A wrongly configured timer is off by a factor.
const CLOCK_TOLERANCE_PPM: f64 = 20_000.0;
/// Longest stall of the computer that may falsify the measured clock.
const STALL_S: f64 = 0.05;
/// Instants are rounded to whole nanoseconds.
const INSTANT_ROUNDING_S: f64 = 0.5e-9;

/// Converts seconds to milliseconds, rounded to 1 ns.
pub(crate) fn rounded_ms(t_s: f64) -> f64 {
    (t_s * 1e9).round() / 1e6
}

pub(crate) fn find_exclusion(scenario: &Scenario, rows: &[Row], telemetry: &Telemetry) -> Option<Exclusion> {
    let timing = telemetry.timing.as_ref();
    let clock = timing.filter(|timing| timing.pacing == "target");
    let clock = clock.and_then(|timing| timing.target_clock_ppm.zip(timing.target_clock_error_ppm));
    unplanned_silence(scenario, rows)
        .or_else(|| late_bench(scenario, rows))
        .or_else(|| clock.and_then(|(ppm, error)| wrong_clock(scenario, ppm, error)))
        .or_else(|| lost_rows(timing.map_or(0, |timing| timing.lost_rows)))
        .or_else(|| incomplete_trace(scenario, rows))
}

fn unplanned_silence(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    let is_planned = |row: &&Row| Time::from_seconds(row.t_s).is_some_and(|time| scenario.explains_silence(time));
    let mut flagged = rows.iter().filter(|row| row.flags.contains(Flags::LINK_LOST));
    flagged.find(|row| !is_planned(row)).map(|row| Exclusion::NoAnswer { at_ms: rounded_ms(row.t_s) })
}

fn late_bench(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    let late = || rows.iter().filter(|row| row.flags.contains(Flags::OVERRUN));
    let expectations = scenario.expectations.iter();
    let limits = expectations.filter(|expectation| expectation.metric == Metric::Overruns);
    let allowed = limits.map(|expectation| expectation.range().1).reduce(f64::min).unwrap_or(0.0);
    let (count, first) = (late().count(), late().next()?);
    (count as f64 > allowed).then(|| Exclusion::LateBench { count, first_ms: rounded_ms(first.t_s) })
}

pub(crate) fn wrong_clock(scenario: &Scenario, ppm: f64, error_ppm: f64) -> Option<Exclusion> {
    let allowed = CLOCK_TOLERANCE_PPM + 4.0 * error_ppm + STALL_S / scenario.duration.seconds() * 1e6;
    (ppm.abs() > allowed).then_some(Exclusion::WrongClock { ppm })
}

pub(crate) fn lost_rows(count: u64) -> Option<Exclusion> {
    (count > 0).then_some(Exclusion::LostRows { count })
}

fn incomplete_trace(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    if let Some(first) = rows.first().filter(|row| row.t_s > 0.0) {
        return Some(Exclusion::LateStart { at_ms: rounded_ms(first.t_s) });
    }
    let widest = scenario.trace_step.seconds() + INSTANT_ROUNDING_S;
    let gap = rows.array_windows().find(|[left, right]| right.t_s - left.t_s > widest);
    if let Some([left, right]) = gap {
        let [from_ms, to_ms] = [left, right].map(|row| rounded_ms(row.t_s));
        return Some(Exclusion::Gap { from_ms, to_ms, step_ms: scenario.trace_step.ms() });
    }
    let end = rows.last().map_or(0.0, |row| row.t_s);
    (end < scenario.duration.seconds())
        .then(|| Exclusion::EarlyEnd { at_ms: rounded_ms(end), duration_ms: scenario.duration.ms() })
}
