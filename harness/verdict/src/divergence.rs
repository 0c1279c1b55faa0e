//! Whether a trial's loop converged at all, off its trace.
//!
//! An unstable loop does not run off to infinity: the amplifier gives no less than 0 V and no more than its limit, the frequency moves no faster than its
//! slew, and what is left is an oscillation that does not die out. So a loop counts as diverged where, after the last thing that happened to it, the amplitude
//! keeps leaving the band around the setpoint, by a swing to both sides that does not decay. An offset, a drive that is merely at its limit, a slow approach,
//! an oscillation that dies out and the sensor's noise are all something else, and are not called so.
//!
//! A command that is no number is a divergence as well: the rig told of it, since no trace holds such a value.
//!
//! `docs/verdicts.md` says it for users. What is decided elsewhere: a divergence fails nothing by itself, it is why an expectation failed
//! ([`mod@crate::judge`]).

use crate::record::{NotFinite, Telemetry};
use platebench_plate::Time;
use platebench_scenario::Scenario;
use platebench_trace::{Flags, Row};
use std::fmt;

/// Half the band that a loop has to come into, and that a swing has to leave on either side, in units of the setpoint.
const BAND: f64 = 0.05;
/// A swing within so many standard deviations of the sensor's noise may be nothing but that: the noise of 10⁵ samples reaches 4.5, and a loop that settles
/// amplifies it by some factor of its own.
const NOISE_REACH: f64 = 25.0;
/// Control periods that each third of the time after the last event has to have: a shorter one shows no swing.
const LEAST_PERIODS: f64 = 10.0;
/// How often a swing changes sides in a third, at the least.
const LEAST_CHANGES: u32 = 3;
/// A swing that keeps this share of itself from one third to the next is not dying out: at this pace it would take some hundred thirds to come into the band.
const SUSTAINED: f64 = 0.98;
/// The same where the drive is thrown from 0 V to the limit and back in either third: what the amplifier cuts off comes and goes.
const SUSTAINED_AT_LIMITS: f64 = 0.9;
/// After so many control periods within the band the loop had converged.
const STAY_PERIODS: f64 = 10.0;
/// A drive counts as at its limit from here on, as a share of it.
const AT_LIMIT: f64 = 1.0 - 1e-6;

/// A trial that came to no good end by itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Divergence {
    /// From when on, s.
    pub at_s: f64,
    /// What was no number, where that is why.
    pub not_finite: Option<NotFinite>,
}

impl fmt::Display for Divergence {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "diverged at t = {:.1} ms", self.at_s * 1e3)?;
        match self.not_finite {
            Some(_) => formatter.write_str(": the commanded drive is not a finite number"),
            None => Ok(()),
        }
    }
}

/// Whether a trial diverged: by a command that is no number, or by a loop that does not converge.
pub fn divergence(scenario: &Scenario, rows: &[Row], telemetry: &Telemetry) -> Option<Divergence> {
    let commanded = telemetry.not_finite.map(|what| Divergence { at_s: what.at_s, not_finite: Some(what) });
    commanded.or_else(|| diverged_at(scenario, rows).map(|at_s| Divergence { at_s, not_finite: None }))
}

/// When, in s, the loop of a trial left the band without ever coming to rest in it again; `None` for every loop that converges, or of which the trace does not
/// show that it does not.
pub fn diverged_at(scenario: &Scenario, rows: &[Row]) -> Option<f64> {
    let period = scenario.controller.period.seconds();
    let held = rows.get(last_event(scenario, rows)..)?;
    let (first, last) = (held.first()?, held.last()?);
    let setpoint = first.setpoint_um;
    let third = (last.t_s - first.t_s) / 3.0;
    // Instants are whole nanoseconds.
    if setpoint <= 0.0 || third + 1e-9 < LEAST_PERIODS * period {
        return None;
    }
    let reach = (BAND * setpoint).max(NOISE_REACH * scenario.plate.noise_um_rms);
    let cut = |time: f64| held.partition_point(|row| row.t_s < time);
    let (second, last_third) = (cut(first.t_s + third), cut(last.t_s - third));
    let thirds = [held.get(second..last_third)?, held.get(last_third..)?];
    let deviation = |row: &Row| row.amplitude_um - setpoint;
    // An offset may leave the band as well; what swings has to be wider than the band by itself.
    let leaves = |rows: &&[Row]| {
        let span = |(low, high): (f64, f64), row: &Row| (low.min(deviation(row)), high.max(deviation(row)));
        let (low, high) = rows.iter().fold((f64::INFINITY, f64::NEG_INFINITY), span);
        high - low > 2.0 * reach
    };
    if !thirds.iter().all(leaves) {
        return None;
    }
    let limit = scenario.plate.drive_limit_vpp;
    let least = if thirds.iter().all(|rows| thrown(rows, limit)) { SUSTAINED_AT_LIMITS } else { SUSTAINED };
    let [before, after] = thirds.map(|rows| size(rows, &deviation));
    // A frequency loop that swings leaves the amplitude on one side of the setpoint only; Wq tells.
    let swings = |signal: &dyn Fn(&Row) -> f64| thirds.iter().all(|rows| changes(rows, reach, signal) >= LEAST_CHANGES);
    let diverged = after >= least * before && (swings(&deviation) || swings(&|row| row.wq_um));
    diverged.then(|| left_for_good(held, reach, STAY_PERIODS * period))
}

/// Index of the row from which on nothing happens any more to a loop but what the loop does: setpoint and surroundings rest, the controller runs, every answer
/// comes, and no planned fault acts.
fn last_event(scenario: &Scenario, rows: &[Row]) -> usize {
    let moved = |pair: &[Row]| match pair {
        [left, right] => {
            left.setpoint_um != right.setpoint_um
                || left.temperature_offset_k != right.temperature_offset_k
                || left.finger_force_n != right.finger_force_n
        }
        _ => false,
    };
    let rested = rows.windows(2).rposition(moved).map_or(0, |index| index + 1);
    let period = scenario.controller.period;
    let disturbed = |row: &Row| {
        row.flags.intersects(Flags::SAFE | Flags::LINK_LOST | Flags::OVERRUN)
            || Time::from_seconds(row.t_s).is_some_and(|time| {
                scenario.faults.iter().any(|fault| fault.covers(time) || fault.explains(time, period))
            })
    };
    rows.iter().rposition(disturbed).map_or(0, |index| index + 1).max(rested)
}

/// How often a signal goes from beyond `reach` on one side of 0 to beyond it on the other.
fn changes(rows: &[Row], reach: f64, signal: &dyn Fn(&Row) -> f64) -> u32 {
    let mut side = 0.0;
    let mut changes = 0;
    for value in rows.iter().map(signal).filter(|value| value.abs() > reach) {
        changes += u32::from(value * side < 0.0);
        side = value;
    }
    changes
}

/// Standard deviation of a signal around its own mean, weighted with time.
fn size(rows: &[Row], signal: &dyn Fn(&Row) -> f64) -> f64 {
    let (mut length, mut area, mut squares) = (0.0, 0.0, 0.0);
    for pair in rows.windows(2) {
        let [left, right] = pair else { continue };
        let (span, value) = (right.t_s - left.t_s, signal(left));
        length += span;
        area += span * value;
        squares += span * value * value;
    }
    if length > 0.0 { (squares / length - (area / length).powi(2)).max(0.0).sqrt() } else { 0.0 }
}

/// True where the drive goes from 0 V to `limit` and back again and again.
fn thrown(rows: &[Row], limit: f64) -> bool {
    let mut at_limit = None;
    let mut changes = 0;
    for row in rows {
        let now = if row.drive_vpp >= limit * AT_LIMIT {
            true
        } else if row.drive_vpp == 0.0 {
            false
        } else {
            continue;
        };
        changes += u32::from(at_limit.replace(now).is_some_and(|before| before != now));
    }
    changes >= LEAST_CHANGES
}

/// When the amplitude first left the band after its last stay in it of at least `stay` seconds, or after it had first come into it.
fn left_for_good(rows: &[Row], reach: f64, stay: f64) -> f64 {
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
