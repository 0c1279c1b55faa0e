//! Detects a loop that does not converge (`docs/verdicts.md`). A
//! divergence explains a failure and never causes one.
//!
//! Drive and frequency slew are limited, so an unstable loop keeps oscillating but does not grow
//! without bound. A loop diverges if, after the last event of the trial, the amplitude keeps
//! leaving the band around the setpoint to both sides and this swing does not decay. A trace cannot
//! contain a NaN or infinite drive command; the rig reports it.

use platebench_model::record::{Divergence, Telemetry};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;

/// Half width of the band, as a share of the setpoint.
const BAND_HALF_WIDTH: f64 = 0.05;
/// A swing below this many standard deviations of the sensor noise may be noise. The extreme of 10⁵
/// samples is at 4.5 deviations, and a settled loop amplifies noise.
const NOISE_DEVIATIONS: f64 = 25.0;
/// Least length of each third of the time after the last event, in control periods.
const MIN_PERIODS: f64 = 10.0;
const MIN_SIDE_CHANGES: u32 = 3;
/// With this ratio of a swing to the one before, the decay takes about a hundred thirds.
const MIN_DECAY_RATIO: f64 = 0.98;
/// Replaces `MIN_DECAY_RATIO` if the drive switches between 0 V and its limit in both thirds,
/// because the effect of clipping varies.
const MIN_DECAY_RATIO_AT_LIMITS: f64 = 0.9;
const CONVERGED_PERIODS: f64 = 10.0;
const LIMIT_SHARE: f64 = 1.0 - 1e-6;

pub(crate) fn detect_divergence(scenario: &Scenario, rows: &[Row], telemetry: &Telemetry) -> Option<Divergence> {
    let commanded = telemetry.not_finite.map(|drive| Divergence { at_s: drive.at_s, is_non_finite: true });
    commanded.or_else(|| divergence_time_s(scenario, rows).map(|at_s| Divergence { at_s, is_non_finite: false }))
}

/// Instant at which the loop left the band for good. `None` if it converges or the trace is short.
pub fn divergence_time_s(scenario: &Scenario, rows: &[Row]) -> Option<f64> {
    let last = rows.last()?;
    let setpoint = last.setpoint_um;
    let reach = (BAND_HALF_WIDTH * setpoint).max(NOISE_DEVIATIONS * scenario.plate.noise_um_rms);
    let deviation = |row: &Row| row.amplitude_um - setpoint;
    // A constant offset is outside the band too, so the swing itself must be wider.
    let leaves = |rows: &&[Row]| {
        let span = |(low, high): (f64, f64), row: &Row| (low.min(deviation(row)), high.max(deviation(row)));
        let (low, high) = rows.iter().fold((f64::INFINITY, f64::NEG_INFINITY), span);
        high - low > 2.0 * reach
    };
    // Most trials end here: the last third after the last event is part of the trial's last third.
    let of_trial = rows.partition_point(|row| row.t_s < last.t_s - last.t_s / 3.0);
    if setpoint <= 0.0 || !leaves(&rows.get(of_trial..)?) {
        return None;
    }
    let period = scenario.controller.period.seconds();
    let held = rows.get(row_after_last_event(scenario, rows)..)?;
    let first = held.first()?;
    let third = (last.t_s - first.t_s) / 3.0;
    // Instants are rounded to nanoseconds, so 1 ns is tolerated.
    if third + 1e-9 < MIN_PERIODS * period {
        return None;
    }
    let cut = |time: f64| held.partition_point(|row| row.t_s < time);
    let (second, last_third) = (cut(first.t_s + third), cut(last.t_s - third));
    let thirds = [held.get(second..last_third)?, held.get(last_third..)?];
    if !thirds.iter().all(leaves) {
        return None;
    }
    let limit = scenario.plate.drive_limit_vpp;
    let least = if thirds.iter().all(|rows| switches_between_limits(rows, limit)) {
        MIN_DECAY_RATIO_AT_LIMITS
    } else {
        MIN_DECAY_RATIO
    };
    let [before, after] = thirds.map(|rows| standard_deviation(rows, &deviation));
    // An oscillating frequency loop keeps the amplitude low, but Wq changes its sign.
    let swings = |signal: &dyn Fn(&Row) -> f64| {
        thirds.iter().all(|rows| count_side_changes(rows, reach, signal) >= MIN_SIDE_CHANGES)
    };
    let diverged = after >= least * before && (swings(&deviation) || swings(&|row| row.wq_um));
    diverged.then(|| final_band_exit_s(held, reach, CONVERGED_PERIODS * period))
}

/// Index of the first row after the last event. From this row on, setpoint and conditions are
/// constant, the controller answers, and no fault acts.
fn row_after_last_event(scenario: &Scenario, rows: &[Row]) -> usize {
    let moved = |[left, right]: &[Row; 2]| {
        left.setpoint_um != right.setpoint_um
            || left.temperature_offset_k != right.temperature_offset_k
            || left.finger_force_n != right.finger_force_n
    };
    let rested = rows.array_windows().rposition(moved).map_or(0, |index| index + 1);
    let period = scenario.controller.period;
    let disturbed = |row: &Row| {
        row.flags.intersects(Flags::SAFE | Flags::LINK_LOST | Flags::OVERRUN)
            || Time::from_seconds(row.t_s).is_some_and(|time| {
                scenario.faults.iter().any(|fault| fault.is_active_at(time) || fault.can_explain(time, period))
            })
    };
    rows.iter().rposition(disturbed).map_or(0, |index| index + 1).max(rested)
}

/// Counts changes from beyond `reach` on one side of 0 to beyond it on the other side.
fn count_side_changes(rows: &[Row], reach: f64, signal: &dyn Fn(&Row) -> f64) -> u32 {
    let mut side = 0.0;
    let mut changes = 0;
    for value in rows.iter().map(signal).filter(|value| value.abs() > reach) {
        changes += u32::from(value * side < 0.0);
        side = value;
    }
    changes
}

/// Weights each row by its duration.
fn standard_deviation(rows: &[Row], signal: &dyn Fn(&Row) -> f64) -> f64 {
    let (mut length, mut area, mut squares) = (0.0, 0.0, 0.0);
    for [left, right] in rows.array_windows() {
        let (span, value) = (right.t_s - left.t_s, signal(left));
        length += span;
        area += span * value;
        squares += span * value * value;
    }
    if length > 0.0 { (squares / length - (area / length).powi(2)).max(0.0).sqrt() } else { 0.0 }
}

pub(crate) fn switches_between_limits(rows: &[Row], limit: f64) -> bool {
    let mut at_limit = None;
    let mut changes = 0;
    for row in rows {
        let now = if row.drive_vpp >= limit * LIMIT_SHARE {
            true
        } else if row.drive_vpp == 0.0 {
            false
        } else {
            continue;
        };
        changes += u32::from(at_limit.replace(now).is_some_and(|before| before != now));
    }
    changes >= MIN_SIDE_CHANGES
}

/// Time of the last exit from the band after a stay of at least `stay` seconds. If no stay was as
/// long, the time of the first exit.
fn final_band_exit_s(rows: &[Row], reach: f64, stay: f64) -> f64 {
    let start = rows.first().map_or(0.0, |row| row.t_s);
    let mut left = None;
    let mut entered = None;
    for row in rows {
        if (row.amplitude_um - row.setpoint_um).abs() <= reach {
            entered.get_or_insert(row.t_s);
        } else if let Some(since) = entered.take()
            && (left.is_none() || row.t_s - since >= stay)
        {
            left = Some(row.t_s);
        }
    }
    left.unwrap_or(start)
}

#[cfg(test)]
mod tests;
