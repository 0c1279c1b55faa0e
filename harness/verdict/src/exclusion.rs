//! Decides whether a trial counts.
//!
//! On the simulated plate, a trial counts if the bench was in time and the trace is complete. The
//! rows of a real plate contain what the controller reports about itself. Such a trial counts if all
//! reports were received, the controller held the setpoints that it was sent, and the operator
//! produced the conditions.

use platebench_model::metrics::DriveBound;
use platebench_model::record::{Exclusion, Excuse, RealPlateRecord, Telemetry};
use platebench_model::scenario::{Expectation, Metric, Scenario};
use platebench_model::trace::{Flags, Row};
use platebench_plate::{Profile, Time};

/// Twice the error of an on-chip oscillator, 1 %. A wrongly configured timer is off by a factor.
const CLOCK_TOLERANCE_PPM: f64 = 20_000.0;
/// Longest stall of the computer that may falsify the measured clock. A silence that begins this
/// soon after a late bench is a consequence of the same stall.
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
    let silences = || rows.iter().enumerate().filter(|(_, row)| is_unplanned_silence(scenario, row));
    let no_answer = |(_, row): (usize, &Row)| Exclusion::NoAnswer { at_ms: rounded_ms(row.t_s) };
    silences()
        .find(|(index, _)| !follows_late_bench(rows, *index))
        .map(no_answer)
        .or_else(|| late_bench(scenario, rows))
        .or_else(|| silences().next().map(no_answer))
        .or_else(|| clock.and_then(|(ppm, error)| wrong_clock(scenario, ppm, error)))
        .or_else(|| lost_rows(timing.map_or(0, |timing| timing.lost_rows)))
        .or_else(|| incomplete_trace(scenario, rows))
}

fn is_unplanned_silence(scenario: &Scenario, row: &Row) -> bool {
    let is_planned = || Time::from_seconds(row.t_s).is_some_and(|time| scenario.explains_silence(time));
    row.flags.contains(Flags::LINK_LOST) && !is_planned()
}

/// True if the bench was late shortly before the row. The stall may also have delayed a controller
/// on the same computer.
fn follows_late_bench(rows: &[Row], index: usize) -> bool {
    let Some((row, earlier)) = rows.get(..=index).and_then(<[Row]>::split_last) else { return false };
    let is_near = |before: &&Row| row.t_s - before.t_s <= STALL_S;
    earlier.iter().rev().take_while(is_near).any(|before| before.flags.contains(Flags::OVERRUN))
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

/// Time after a setpoint change in which the previous setpoint is accepted.
const MAX_SETPOINT_DELAY: Time = Time::from_nanos(100_000_000);
/// The wire carries setpoints as f32.
const SETPOINT_TOLERANCE: f64 = 1e-6;
pub const OPERATOR_TIME_TOLERANCE: Time = Time::from_nanos(1_000_000_000);
/// A person cannot act on time in a shorter trial.
pub const MIN_DURATION_FOR_OPERATOR: Time = Time::from_nanos(2_000_000_000);
/// A hand cannot hold a force more exactly.
const FORCE_TOLERANCE_N: f64 = 0.3;
const FORCE_TOLERANCE_SHARE: f64 = 0.2;
const MAX_WRONG_FORCE_SHARE: f64 = 0.05;

pub fn needs_operator(scenario: &Scenario) -> bool {
    condition_ranges(scenario).iter().any(|range| *range != (0.0, 0.0))
}

pub fn scene_changes(scenario: &Scenario) -> bool {
    condition_ranges(scenario).iter().any(|(low, high)| low < high)
}

fn condition_ranges(scenario: &Scenario) -> [(f64, f64); 2] {
    let conditions = &scenario.conditions;
    [conditions.temperature_offset_k.range(), conditions.finger_force_n.range()]
}

pub fn operator_exclusion(scenario: &Scenario) -> Option<Exclusion> {
    (scene_changes(scenario) && scenario.duration < MIN_DURATION_FOR_OPERATOR)
        .then(|| Exclusion::TooFastForOperator { duration_ms: scenario.duration.ms() })
}

pub(crate) fn find_real_plate_exclusion(
    scenario: &Scenario,
    rows: &[Row],
    record: Option<&RealPlateRecord>,
) -> Option<Exclusion> {
    let flagged = |flag: Flags| rows.iter().find(|row| row.flags.contains(flag)).map(|row| rounded_ms(row.t_s));
    wrong_conditions(scenario, rows, record)
        .or_else(|| flagged(Flags::LINK_LOST).map(|at_ms| Exclusion::Unacknowledged { at_ms }))
        .or_else(|| record?.clock_ppm.and_then(|[ppm, error]| wrong_clock(scenario, ppm, error)))
        .or_else(|| lost_rows(record.map_or(0, |record| record.lost_rows)))
        .or_else(|| flagged(Flags::OVERRUN).map(|at_ms| Exclusion::LateSetpoint { at_ms }))
        .or_else(|| missing_telemetry(scenario, rows))
        .or_else(|| wrong_setpoint(scenario, rows))
}

/// The drive that a real plate needs is unknown, so every saturation is an excuse.
pub(crate) fn saturation_excuse(expectation: &Expectation, rows: &[Row]) -> Option<Excuse> {
    let saturated = rows.iter().find(|row| row.flags.contains(Flags::SATURATED))?;
    let is_limited = expectation.metric.spec().drive_bound != DriveBound::None;
    is_limited.then(|| Excuse::SaturatedRealPlate { at_ms: rounded_ms(saturated.t_s) })
}

fn missing_telemetry(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    let widest = 1.5 * scenario.controller.period.seconds();
    let first = rows.first()?;
    if first.t_s > widest {
        return Some(Exclusion::LateTelemetry { at_ms: rounded_ms(first.t_s) });
    }
    let gap = rows.array_windows().find(|[left, right]| right.t_s - left.t_s > widest);
    if let Some([left, right]) = gap {
        return Some(Exclusion::TelemetryGap { from_ms: rounded_ms(left.t_s), to_ms: rounded_ms(right.t_s) });
    }
    // A controller that stopped sends no more telemetry; the metrics judge the stop.
    let last = rows.last().filter(|last| !last.flags.contains(Flags::SAFE))?;
    (last.t_s < scenario.duration.seconds())
        .then(|| Exclusion::EarlyTelemetryEnd { at_ms: rounded_ms(last.t_s), duration_ms: scenario.duration.ms() })
}

fn wrong_setpoint(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    let range_at = |row: &Row| range_around(&scenario.setpoint, row.t_s, MAX_SETPOINT_DELAY);
    let wrong = rows.iter().filter(|row| !row.flags.contains(Flags::SAFE)).find(|row| {
        let [low, high] = range_at(row);
        let margin = SETPOINT_TOLERANCE * high.abs().max(low.abs());
        let is_held = |value: f64| (value - row.setpoint_um).abs() <= margin;
        match &scenario.setpoint {
            Profile::Hold(_) => {
                !values_around(&scenario.setpoint, row.t_s, MAX_SETPOINT_DELAY).into_iter().any(is_held)
            }
            _ => !(low - margin..=high + margin).contains(&row.setpoint_um),
        }
    })?;
    let (held_um, at_ms) = (wrong.setpoint_um, rounded_ms(wrong.t_s));
    Some(Exclusion::WrongSetpoint { held_um, at_ms, sent_um: range_at(wrong) })
}

fn wrong_conditions(scenario: &Scenario, rows: &[Row], record: Option<&RealPlateRecord>) -> Option<Exclusion> {
    if let Some(why) = record.and_then(|record| record.undone.clone()) {
        return Some(Exclusion::ConditionsNotMade { why });
    }
    if needs_operator(scenario) {
        if let Some(exclusion) = operator_exclusion(scenario) {
            return Some(exclusion);
        }
        if record.is_none() {
            return Some(Exclusion::UnknownConditions);
        }
    }
    let range_at = |row: &Row| range_around(&scenario.conditions.finger_force_n, row.t_s, OPERATOR_TIME_TOLERANCE);
    let is_wrong = |row: &&Row| {
        let [low, high] = range_at(row);
        let margin = FORCE_TOLERANCE_N + FORCE_TOLERANCE_SHARE * high.abs().max(low.abs());
        !(low - margin..=high + margin).contains(&row.finger_force_n)
    };
    let measured = || rows.iter().filter(|row| !row.finger_force_n.is_nan());
    let (wrong_rows, rows) = (measured().filter(is_wrong).count(), measured().count());
    let first = measured().find(is_wrong)?;
    (wrong_rows as f64 > MAX_WRONG_FORCE_SHARE * rows as f64).then(|| Exclusion::WrongForce {
        force_n: first.finger_force_n,
        at_ms: rounded_ms(first.t_s),
        expected_n: range_at(first),
        wrong_rows,
        rows,
    })
}

/// Smallest and largest value of `profile` from `within` before `t_s` to `within` after it.
fn range_around(profile: &Profile, t_s: f64, within: Time) -> [f64; 2] {
    if let Profile::Sine { .. } = profile {
        let (low, high) = profile.range();
        return [low, high];
    }
    let values = values_around(profile, t_s, within).into_iter();
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// Values of `profile` at both ends of `t_s` ± `within` and at its points in between.
fn values_around(profile: &Profile, t_s: f64, within: Time) -> Vec<f64> {
    let time = Time::from_seconds(t_s).unwrap_or(Time::ZERO);
    let (from, to) = (time.since(within), time + within);
    let points = std::iter::successors(profile.next_point_after(from), |point| profile.next_point_after(*point));
    points.take_while(|point| *point < to).chain([from, to]).map(|time| profile.at(time)).collect()
}

#[cfg(test)]
mod tests;
