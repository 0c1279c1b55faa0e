//! Names a likely cause of a bad trace (`docs/verdicts.md`). A symptom decides no verdict.

use crate::divergence::switches_between_limits;
use platebench_controller::design::{PiGains, closed_loop_pole, default_response_time_s};
use platebench_model::record::{LoopSymptom, Telemetry};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Flags, Row};
use platebench_wire::LawId;

/// Least number of control periods that show a symptom.
const MIN_PERIODS: usize = 10;
/// Distance to the limit of the frequency that counts as at the limit. The wire rounds to 1 mHz.
const AT_LIMIT_HZ: f64 = 5e-3;
/// Number of ranges from the start from which the layout of the command is suspected.
const FAR_RANGES: f64 = 10.0;
/// Share of the drive limit from which the drive is at its limit.
const LIMIT_SHARE: f64 = 1.0 - 1e-6;
/// Control periods at a limit after which an overshoot has no other likely cause than wind-up.
const LIMITED_PERIODS: usize = 3;
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
/// Instants of a trace are whole nanoseconds, s.
const SAME_INSTANT_S: f64 = 5e-10;
/// Least number of unlimited changes of the drive from which gains are fitted.
const MIN_CHANGES: usize = 4;
/// Least share of their squares by which the two causes of a change differ.
const MIN_SEPARATION: f64 = 0.05;
/// Largest relative difference of the ratio from that of the pole.
const SAME_RATIO: f64 = 0.1;
/// Largest share of the changes' squares that a PI law leaves unexplained.
const UNEXPLAINED: f64 = 0.01;
/// Largest relative difference of two gain ratios that count as equal.
const SAME_GAIN: f64 = 0.1;
/// Gains are far from the design if one is larger or smaller by this factor.
const GAIN_FACTOR: f64 = 1.5;

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
    if driven.iter().any(|row| has_far_frequency(scenario, row)) {
        return Some(LoopSymptom::FarFrequency);
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
    } else if !is_disturbed && ends_driven_above_setpoint(&driven, limit) {
        Some(if was_below_for_long(&driven, limit) { LoopSymptom::WindUp } else { LoopSymptom::LimitAboveSetpoint })
    } else if scenario.controller.law == OPEN_LOOP {
        None
    } else if is_unmoved(&driven, limit) {
        Some(LoopSymptom::UnmovedDrive)
    } else {
        far_gains(scenario, rows)
            .or_else(|| (!is_disturbed && overshoots_after_limit(&driven, limit)).then_some(LoopSymptom::WindUp))
    }
}

fn has_far_frequency(scenario: &Scenario, row: &Row) -> bool {
    let controller = &scenario.controller;
    (row.frequency_hz - controller.start_frequency_hz).abs() > FAR_RANGES * controller.frequency_range_hz
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

/// Error of Wd, which the amplitude loop controls, relative to the setpoint; positive above it.
fn error(row: &Row) -> f64 {
    row.wd_um / row.setpoint_um - 1.0
}

/// True if the drive is at its limit at the end although Wd is far above the setpoint.
fn ends_driven_above_setpoint(driven: &[&Row], limit: f64) -> bool {
    let end = driven.get(driven.len().saturating_sub(MIN_PERIODS)..).unwrap_or_default();
    end.iter().all(|row| row.drive_vpp >= limit * LIMIT_SHARE && error(row) > FAR)
}

/// True if the error below the setpoint, summed since the drive reached its limit, exceeds the one
/// above it. An integral without anti-windup keeps the drive at its limit until both are equal.
fn was_below_for_long(driven: &[&Row], limit: f64) -> bool {
    let at_limit = driven.iter().rev().take_while(|row| row.drive_vpp >= limit * LIMIT_SHARE);
    at_limit.map(|row| row.wd_um - row.setpoint_um).sum::<f64>() < 0.0
}

/// A control step: the error of the sample, and the drive that answers it.
struct ControlStep {
    at_s: f64,
    setpoint_um: f64,
    error_um: f64,
    drive_vpp: f64,
}

/// The drive of a row acts from the row on, so the last row before the next sample has the answer.
fn control_steps(rows: &[Row]) -> Vec<ControlStep> {
    let mut steps: Vec<ControlStep> = Vec::new();
    for row in rows {
        if row.flags.contains(Flags::CONTROL) {
            let Row { t_s: at_s, setpoint_um, sensed_wd_um, drive_vpp, .. } = *row;
            steps.push(ControlStep { at_s, setpoint_um, error_um: setpoint_um - sensed_wd_um, drive_vpp });
        } else if let Some(step) = steps.last_mut() {
            step.drive_vpp = row.drive_vpp;
        }
    }
    steps
}

/// True if Wd passes the setpoint far after periods at a limit. With anti-windup it does not.
fn overshoots_after_limit(driven: &[&Row], limit: f64) -> bool {
    driven.windows(LIMITED_PERIODS + 2).any(|rows| {
        let (limited, after) = rows.split_at(LIMITED_PERIODS);
        let is_constant = rows.iter().all(|row| row.setpoint_um == rows[0].setpoint_um);
        let stays = |is_limit: &dyn Fn(&Row) -> bool| limited.iter().all(|row| is_limit(row));
        let passes = |sign: f64| error(rows[0]) * sign < 0.0 && after.iter().any(|row| error(row) * sign > FAR);
        is_constant
            && (stays(&|row| row.drive_vpp >= limit * LIMIT_SHARE) && passes(1.0)
                || stays(&|row| row.drive_vpp == 0.0) && passes(-1.0))
    })
}

fn far_gains(scenario: &Scenario, rows: &[Row]) -> Option<LoopSymptom> {
    let [kp, ki] = fit_gains(scenario, rows)?;
    let is_far = [kp, ki].iter().any(|ratio| !(1.0 / GAIN_FACTOR..=GAIN_FACTOR).contains(ratio));
    // An own law may have another design. One wrong figure changes one gain, or both by one factor.
    let is_same = |one: f64, other: f64| (one / other - 1.0).abs() <= SAME_GAIN;
    let is_one_figure = is_same(kp, ki) || is_same(kp, 1.0) || is_same(ki, 1.0);
    (is_far && (is_one_figure || !scenario.has_own_law())).then_some(LoopSymptom::FarGains { kp, ki })
}

/// Fits `u − u′ = Kp (e − e′) + Ki T e′ + c`, with the values e′ and u′ of the step before, to the
/// unlimited changes of the drive; c stands for an offset of the sample. Returns the gains relative
/// to the design of `docs/wire-protocol.md`. `None` if a PI law does not explain the changes.
///
/// If e decays with one pole p, the changes do not separate the gains. Then the zero of the law
/// cancels the pole of the plate, as in the design, so both have the same ratio r to the design,
/// whose pole is d: `1 − p = r (1 − d)`.
fn fit_gains(scenario: &Scenario, rows: &[Row]) -> Option<[f64; 2]> {
    let limit = scenario.plate.drive_limit_vpp;
    let period_s = scenario.controller.period.seconds();
    let is_unlimited = |step: &ControlStep| step.drive_vpp > 0.0 && step.drive_vpp < limit * LIMIT_SHARE;
    let changes: Vec<[f64; 3]> = control_steps(rows)
        .array_windows()
        .filter(|[before, step]| {
            let is_next = (step.at_s - before.at_s - period_s).abs() < SAME_INSTANT_S;
            let is_constant = before.setpoint_um == step.setpoint_um && step.setpoint_um > 0.0;
            is_next && is_constant && is_unlimited(before) && is_unlimited(step)
        })
        .map(|[before, step]| [step.error_um - before.error_um, before.error_um, step.drive_vpp - before.drive_vpp])
        .collect();
    if changes.len() < MIN_CHANGES {
        return None;
    }
    let sum = |product: &dyn Fn(&[f64; 3]) -> f64| changes.iter().map(product).sum::<f64>();
    let mean = [0, 1, 2].map(|column: usize| sum(&|change| change[column]) / changes.len() as f64);
    let moment = |one: usize, other: usize| sum(&|change| (change[one] - mean[one]) * (change[other] - mean[other]));
    let [pp, pi, ii] = [moment(0, 0), moment(0, 1), moment(1, 1)];
    let [up, ui, uu] = [moment(2, 0), moment(2, 1), moment(2, 2)];
    let plate = scenario.controller.design_plate.as_ref().unwrap_or(&scenario.plate);
    let response_time_ms = scenario.controller.response_time_ms;
    let response_s = response_time_ms.map_or(default_response_time_s(LawId::DqPi), |ms| ms * 1e-3);
    let PiGains { proportional, integral_per_period } =
        PiGains::zero_order_hold_matched(plate.gain, 1.0 / plate.sigma0, response_s, period_s);
    let determinant = pp * ii - pi * pi;
    let [kp, ki] = if determinant > MIN_SEPARATION * pp * ii {
        let [kp, ki_t] = [(up * ii - ui * pi) / determinant, (ui * pp - up * pi) / determinant];
        [kp / proportional, ki_t / integral_per_period]
    } else {
        let square = proportional * (proportional * pp + 2.0 * integral_per_period * pi)
            + integral_per_period * integral_per_period * ii;
        let ratio = (proportional * up + integral_per_period * ui) / square;
        let ratio_of_pole = -pi / ii / (1.0 - closed_loop_pole(response_s, period_s));
        if (ratio / ratio_of_pole - 1.0).abs() > SAME_RATIO {
            return None;
        }
        [ratio, ratio]
    };
    let unexplained = uu - kp * proportional * up - ki * integral_per_period * ui;
    (unexplained <= UNEXPLAINED * uu).then_some([kp, ki])
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
