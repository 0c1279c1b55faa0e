//! What a trial on a real plate is worth.
//!
//! No emulator stands behind the rows: motion, setpoint and drive are what the controller that drives the plate tells of itself, and the surroundings are what a
//! person made them. A trial counts where all of it was heard, where the controller held the setpoints that it was sent, and where there is reason to believe that finger and
//! temperature were those of the scenario. Which metric can be had at all is with the [`metrics`](crate::metrics).

use crate::feasibility::is_bound_by_drive;
use crate::judge::{Excuse, other_clock};
use crate::record::{Cause, RealPlate};
use platebench_plate::{Profile, Time};
use platebench_scenario::{Expectation, Scenario};
use platebench_trace::{Flags, Row};

/// A setpoint takes this long at most from the profile to the controller; for as long an earlier one still may be in force.
const SETPOINT_WITHIN: Time = Time::from_nanos(100_000_000);
/// The wire carries setpoints as f32.
const SETPOINT_TOLERANCE: f64 = 1e-6;
/// A person does what was asked for this much earlier or later.
pub const PERSON_WITHIN: Time = Time::from_nanos(1_000_000_000);
/// In a trial that is shorter than this nobody can move anything on time.
pub const SHORTEST_TO_MOVE: Time = Time::from_nanos(2_000_000_000);
/// How far a hand may be off, N and as a share of what was asked for.
const HAND_N: f64 = 0.3;
const HAND_SHARE: f64 = 0.2;
/// The share of rows in which it may be farther off.
const HAND_SLIPS: f64 = 0.05;

/// True where a person has to warm or to touch the plate for `scenario`.
pub fn needs_person(scenario: &Scenario) -> bool {
    let scene = &scenario.scene;
    [&scene.temperature_offset_k, &scene.finger_force_n].iter().any(|profile| profile.range() != (0.0, 0.0))
}

/// True where the surroundings change within a trial of `scenario`.
pub fn moves(scenario: &Scenario) -> bool {
    let scene = &scenario.scene;
    [&scene.temperature_offset_k, &scene.finger_force_n].iter().any(|profile| {
        let (low, high) = profile.range();
        low < high
    })
}

/// Why no person can do what `scenario` asks for.
pub fn impossible(scenario: &Scenario) -> Option<String> {
    (moves(scenario) && scenario.duration < SHORTEST_TO_MOVE).then(|| {
        format!("finger or temperature change within a trial of {}, which no person can do", scenario.duration)
    })
}

/// What happened in a trial on a real plate that is not the controller's doing.
pub(crate) fn disturbance(scenario: &Scenario, rows: &[Row], told: Option<&RealPlate>) -> Option<(Cause, String)> {
    let clock = told.and_then(|told| told.clock_ppm);
    surroundings(scenario, rows, told)
        .or_else(|| flagged(rows))
        .or_else(|| clock.and_then(|[ppm, error]| other_clock(scenario, ppm, error)))
        .map(|what| (Cause::Rig, what))
        .or_else(|| {
            let lost = told.map_or(0, |told| told.lost_rows);
            (lost > 0).then(|| (Cause::Bench, format!("{lost} rows were lost on their way out of the loop")))
        })
        .or_else(|| {
            let late = rows.iter().find(|row| row.flags.contains(Flags::OVERRUN))?;
            Some((Cause::Bench, format!("the bench was too late with a setpoint at {} ms", shown_ms(late.t_s))))
        })
        .or_else(|| silence(scenario, rows).or_else(|| other_setpoint(scenario, rows)).map(|what| (Cause::Rig, what)))
}

/// A demand that was missed with the drive at its limit: of a real plate nobody knows what it would have taken.
pub(crate) fn excuse(expectation: &Expectation, rows: &[Row]) -> Option<Excuse> {
    let saturated = rows.iter().find(|row| row.flags.contains(Flags::SATURATED))?;
    is_bound_by_drive(expectation.metric).then(|| Excuse {
        cause: Cause::Evidence,
        reason: format!(
            "the drive was at its limit at {} ms, and nobody knows whether this plate could have been driven better",
            shown_ms(saturated.t_s)
        ),
    })
}

fn shown_ms(t_s: f64) -> f64 {
    (t_s * 1e6).round() / 1e3
}

fn flagged(rows: &[Row]) -> Option<String> {
    let row = rows.iter().find(|row| row.flags.contains(Flags::LINK_LOST))?;
    Some(format!("a setpoint was not acknowledged by {} ms", shown_ms(row.t_s)))
}

/// Telemetry that is missing: at the start, in between or at the end.
fn silence(scenario: &Scenario, rows: &[Row]) -> Option<String> {
    let widest = 1.5 * scenario.controller.period.seconds();
    let first = rows.first()?;
    if first.t_s > widest {
        return Some(format!("the telemetry starts at {} ms", shown_ms(first.t_s)));
    }
    let gap = rows.windows(2).find(|pair| matches!(pair, [left, right] if right.t_s - left.t_s > widest));
    if let Some([left, right]) = gap {
        return Some(format!("no telemetry between {} and {} ms", shown_ms(left.t_s), shown_ms(right.t_s)));
    }
    // A controller that stopped by itself has nothing more to tell; that is judged.
    let last = rows.last().filter(|last| !last.flags.contains(Flags::SAFE))?;
    let missing = last.t_s < scenario.duration.seconds();
    missing.then(|| format!("the telemetry ends at {} ms instead of {}", shown_ms(last.t_s), scenario.duration))
}

/// The first row in which the controller held what nobody had asked for.
fn other_setpoint(scenario: &Scenario, rows: &[Row]) -> Option<String> {
    let asked = |row: &Row| range_around(&scenario.setpoint, row.t_s, SETPOINT_WITHIN);
    let other = rows.iter().filter(|row| !row.flags.contains(Flags::SAFE)).find(|row| {
        let [low, high] = asked(row);
        let margin = SETPOINT_TOLERANCE * high.abs().max(low.abs());
        let is_one = |value: f64| (value - row.setpoint_um).abs() <= margin;
        match &scenario.setpoint {
            // There is nothing between two levels.
            Profile::Hold(_) => !values_around(&scenario.setpoint, row.t_s, SETPOINT_WITHIN).into_iter().any(is_one),
            _ => !(low - margin..=high + margin).contains(&row.setpoint_um),
        }
    })?;
    let (held, at, [low, high]) = (other.setpoint_um, shown_ms(other.t_s), asked(other));
    let wished = if low == high { format!("{low}") } else { format!("{low} to {high}") };
    Some(format!("the controller held a setpoint of {held} µm at {at} ms, it was sent {wished}"))
}

/// Whether finger and temperature were what the scenario asks for, as far as that is known.
fn surroundings(scenario: &Scenario, rows: &[Row], told: Option<&RealPlate>) -> Option<String> {
    if let Some(why) = told.and_then(|told| told.undone.clone()) {
        return Some(why);
    }
    if needs_person(scenario) {
        if let Some(why) = impossible(scenario) {
            return Some(why);
        }
        if told.is_none() {
            return Some("nobody knows whether finger and temperature were those of the scenario".to_owned());
        }
    }
    let wished = |row: &Row| range_around(&scenario.scene.finger_force_n, row.t_s, PERSON_WITHIN);
    let is_off = |row: &&Row| {
        let [low, high] = wished(row);
        let margin = HAND_N + HAND_SHARE * high.abs().max(low.abs());
        !(low - margin..=high + margin).contains(&row.finger_force_n)
    };
    let measured = || rows.iter().filter(|row| !row.finger_force_n.is_nan());
    let off = measured().filter(is_off).count();
    let first = measured().find(is_off)?;
    (off as f64 > HAND_SLIPS * measured().count() as f64).then(|| {
        let [low, high] = wished(first);
        let force = format!("the finger pressed with {:.2} N at {} ms", first.finger_force_n, shown_ms(first.t_s));
        format!("{force}, the scenario asks for {low} to {high}; so in {off} of {} rows", measured().count())
    })
}

/// The smallest and the largest value of `profile` up to `within` before and after `t_s`.
fn range_around(profile: &Profile, t_s: f64, within: Time) -> [f64; 2] {
    if let Profile::Sine { .. } = profile {
        let (low, high) = profile.range();
        return [low, high];
    }
    let values = values_around(profile, t_s, within).into_iter();
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// The values at the points of `profile` up to `within` before and after `t_s`, and at both ends.
fn values_around(profile: &Profile, t_s: f64, within: Time) -> Vec<f64> {
    let time = Time::from_seconds(t_s).unwrap_or(Time::ZERO);
    let (from, to) = (time.since(within), time + within);
    let points = std::iter::successors(profile.next_point_after(from), |point| profile.next_point_after(*point));
    points.take_while(|point| *point < to).chain([from, to]).map(|time| profile.at(time)).collect()
}

#[cfg(test)]
mod tests;
