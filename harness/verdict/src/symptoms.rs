//! Names a likely cause of a bad trace (`docs/verdicts.md`). A symptom decides no verdict.

use crate::divergence::switches_between_limits;
use platebench_model::record::{LoopSymptom, Telemetry};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Flags, Row};

/// Least number of control periods that show a symptom.
const MIN_PERIODS: usize = 10;
/// Distance to the limit of the frequency that counts as at the limit. The wire rounds to 1 mHz.
const AT_LIMIT_HZ: f64 = 5e-3;
/// Share of the drive limit from which the drive is at its limit.
const LIMIT_SHARE: f64 = 1.0 - 1e-6;
/// Control periods at the limit before and after the amplitude passes the setpoint. A correct loop
/// needs one, or two with a delay.
const WIND_UP_PERIODS: usize = 4;
/// Share of the setpoint by which the amplitude must be off.
const FAR: f64 = 0.05;
/// Largest change of a drive that does not move, share of its limit.
const UNMOVED: f64 = 1e-4;
/// A spike differs from both neighbours by the first share of the limit, and they from each other by
/// at most the second.
const SPIKE: f64 = 0.3;
const NEIGHBOUR: f64 = 0.05;
/// A law whose drive follows the setpoint only.
const OPEN_LOOP: &str = "open-loop";

pub(crate) fn detect_symptom(scenario: &Scenario, rows: &[Row], telemetry: &Telemetry) -> Option<LoopSymptom> {
    if telemetry.unused_fpu {
        return Some(LoopSymptom::UnusedFpu);
    }
    if telemetry.not_finite.is_some() {
        return Some(LoopSymptom::NotFinite);
    }
    let runs = |row: &&Row| !row.flags.intersects(Flags::SAFE | Flags::LINK_LOST);
    let controlled = |row: &&Row| row.flags.contains(Flags::CONTROL);
    let driven: Vec<&Row> = rows.iter().filter(runs).filter(controlled).filter(|row| row.setpoint_um > 0.0).collect();
    let all_driven = || rows.iter().filter(runs).filter(|row| row.setpoint_um > 0.0);
    if driven.len() >= MIN_PERIODS && all_driven().all(|row| row.drive_vpp == 0.0) {
        return Some(LoopSymptom::NoDrive);
    }
    let limit = scenario.plate.drive_limit_vpp;
    let last = rows.last().filter(runs);
    let has_wrong_frequency = last.is_some_and(|last| ends_away_from_resonance(scenario, last));
    let is_disturbed = !scenario.faults.is_empty() || !scenario.chip_faults.is_empty();
    if has_wrong_frequency {
        Some(LoopSymptom::FrequencyAtLimit)
    } else if !is_disturbed && has_spike(&driven, limit) {
        Some(LoopSymptom::DriveSpike)
    } else if driven.len() < 2 * MIN_PERIODS {
        None
    } else if switches_between_limits(rows.get(rows.len() / 3 * 2..).unwrap_or_default(), limit) {
        Some(LoopSymptom::SwitchingDrive)
    } else if !is_disturbed && winds_up(&driven, limit) {
        Some(LoopSymptom::WindUp)
    } else {
        let is_unmoved = scenario.controller.law != OPEN_LOOP && is_unmoved(&driven, limit);
        is_unmoved.then_some(LoopSymptom::UnmovedDrive)
    }
}

fn ends_away_from_resonance(scenario: &Scenario, last: &Row) -> bool {
    let controller = &scenario.controller;
    let is_at_limit =
        (last.frequency_hz - controller.start_frequency_hz).abs() >= controller.frequency_range_hz - AT_LIMIT_HZ;
    let distance = |frequency_hz: f64| (frequency_hz - last.resonance_hz).abs();
    // A resonance outside the range leaves a correct loop at the limit too, but nearer to it.
    let is_away =
        distance(last.frequency_hz) > distance(controller.start_frequency_hz) + 0.5 * controller.frequency_range_hz;
    is_at_limit && is_away
}

/// True if one command differs much from those before and after it, at a constant setpoint.
fn has_spike(driven: &[&Row], limit: f64) -> bool {
    driven.windows(4).any(|rows| {
        let [before, spike, after, later] = rows else { return false };
        let is_constant = rows.iter().all(|row| {
            row.setpoint_um == before.setpoint_um && (row.amplitude_um / row.setpoint_um - 1.0).abs() < 4.0 * FAR
        });
        let distance = |one: &Row, other: &Row| (one.drive_vpp - other.drive_vpp).abs() / limit;
        is_constant
            && distance(before, spike) > SPIKE
            && distance(spike, after) > SPIKE
            && distance(before, after) < NEIGHBOUR
            && distance(before, later) < NEIGHBOUR
    })
}

/// True if the drive stays at its limit although the amplitude is far beyond the setpoint.
fn winds_up(driven: &[&Row], limit: f64) -> bool {
    driven.windows(2 * WIND_UP_PERIODS).any(|rows| {
        let (before, after) = rows.split_at(WIND_UP_PERIODS);
        let is_constant = rows.iter().all(|row| row.setpoint_um == rows[0].setpoint_um);
        let error = |row: &&&Row| row.amplitude_um / row.setpoint_um - 1.0;
        let stays = |is_limit: &dyn Fn(&Row) -> bool| rows.iter().all(|row| is_limit(row));
        let passes = |sign: f64| {
            before.iter().all(|row| error(&row) * sign < 0.0)
                && after.iter().skip(1).all(|row| error(&row) * sign > FAR)
        };
        is_constant
            && (stays(&|row| row.drive_vpp >= limit * LIMIT_SHARE) && passes(1.0)
                || stays(&|row| row.drive_vpp == 0.0) && passes(-1.0))
    })
}

/// True if the amplitude stays off the setpoint at the end and the drive does not move.
fn is_unmoved(driven: &[&Row], limit: f64) -> bool {
    let end = driven.get(driven.len() - MIN_PERIODS..).unwrap_or_default();
    let Some(last) = end.last() else { return false };
    let is_held = |row: &&Row| {
        row.setpoint_um == last.setpoint_um
            && (row.drive_vpp - last.drive_vpp).abs() <= UNMOVED * limit
            && row.drive_vpp > 0.0
            && row.drive_vpp < limit * LIMIT_SHARE
            && (row.amplitude_um / row.setpoint_um - 1.0).abs() > FAR
    };
    end.iter().all(is_held)
}

#[cfg(test)]
mod tests;
