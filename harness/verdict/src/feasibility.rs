//! Decides whether any controller could meet a demand within the amplifier's limits.
//!
//! An ideal controller plays the trial again. It is always at resonance and brings the amplitude to
//! the setpoint as fast as the amplifier allows. The amplitude follows the exact envelope
//! `W' = −σ W + b V`; V is the limit while W must rise and 0 while it must fall.

use crate::metrics::{self, Measure};
use platebench_model::metrics::DriveBound;
use platebench_model::record::{BestResponse, Excuse, Telemetry};
use platebench_model::scenario::{Expectation, Scenario};
use platebench_model::trace::{Flags, Row};
use platebench_plate::{Plant, Time};

/// Only a trial that [`may_be_limited`] is excused.
pub(crate) fn infeasibility_excuse(
    scenario: &Scenario,
    expectation: &Expectation,
    plant: &Plant,
    rows: &[Row],
) -> Option<Excuse> {
    if expectation.metric.spec().drive_bound == DriveBound::None
        || matches!(expectation.signal, "wq_um" | "sensed_wq_um")
    {
        return None;
    }
    // The ideal response has one mode. A second mode or an amplifier offset may add to it, so
    // nothing is excused. Bandwidth, slew rate, dead time and latency only slow a loop down, so the
    // ideal response stays a bound.
    let effects = &scenario.plate.effects;
    if effects.second_mode.is_some() || effects.amplifier.offset_vpp != 0.0 {
        return None;
    }
    let limit_vpp = scenario.plate.drive_limit_vpp;
    let ideal = IdealResponse::simulate(expectation, plant, rows, limit_vpp)?;
    if !ideal.falls_with_drive_off && !rows.iter().any(|row| row.flags.contains(Flags::SATURATED)) {
        return None;
    }
    // The ideal amplitude is known at all times, even if the expectation's signal is sampled.
    let plain = Expectation { signal: "amplitude_um", ..expectation.clone() };
    let best = unreachable_best(expectation, &metrics::measure(&plain, &ideal.rows, &Telemetry::default()))?;
    Some(if ideal.required_drive_vpp > limit_vpp {
        Excuse::SetpointOutOfReach { needed_vpp: ideal.required_drive_vpp, limit_vpp, best }
    } else {
        Excuse::DriveLimited { limit_vpp, best }
    })
}

/// False if the drive was neither at its limit nor at 0 V with a setpoint below an earlier level.
/// An ideal response then need not be simulated.
pub(crate) fn may_be_limited(rows: &[Row]) -> bool {
    let mut highest = rows.first().map_or(0.0, |row| row.amplitude_um);
    rows.iter().any(|row| {
        let may_fall = row.drive_vpp == 0.0 && row.setpoint_um < highest;
        highest = highest.max(row.setpoint_um);
        may_fall || row.flags.contains(Flags::SATURATED)
    })
}

/// Best value of the ideal controller if it misses the limit; `None` if it meets the limit.
fn unreachable_best(expectation: &Expectation, best: &Measure) -> Option<BestResponse> {
    let (lowest, highest) = expectation.range();
    let value = match *best {
        Measure::Missing(missing) => return Some(BestResponse::Missing(missing)),
        Measure::Undefined(_) | Measure::Samples(_) => return None,
        Measure::Value(value) | Measure::Interval([value, _]) => value,
    };
    let reached = BestResponse::Value(expectation.metric, value.abs());
    match expectation.metric.spec().drive_bound {
        DriveBound::None => None,
        DriveBound::Smallest => (value.abs() > highest).then_some(reached),
        DriveBound::Largest => (value < lowest).then_some(reached),
        // A mean below the setpoint shows that the drive is too weak.
        DriveBound::MeanBelowSetpoint => (value < 100.0 - RATIO_TOLERANCE_PERCENT).then_some(BestResponse::Mean(value)),
    }
}

/// Rounding error of a mean that equals the setpoint.
const RATIO_TOLERANCE_PERCENT: f64 = 1e-6;

struct IdealResponse {
    rows: Vec<Row>,
    /// True if, with the drive at 0 V, the setpoint fell faster than the plate decays.
    falls_with_drive_off: bool,
    /// Largest drive that is needed to hold the setpoint at resonance, Vpp.
    required_drive_vpp: f64,
}

impl IdealResponse {
    fn simulate(expectation: &Expectation, plant: &Plant, rows: &[Row], limit: f64) -> Option<Self> {
        let first = rows.first()?;
        let mut level = first.amplitude_um;
        let mut ideal =
            Self { rows: vec![with_amplitude(first, level)], falls_with_drive_off: false, required_drive_vpp: 0.0 };
        for [left, right] in rows.array_windows() {
            let (start, end) = (Time::from_seconds(left.t_s)?, Time::from_seconds(right.t_s)?);
            let mode = plant.mode_at(start.midpoint(end));
            let strongest = limit / mode.drive_for(1.0);
            ideal.required_drive_vpp = ideal.required_drive_vpp.max(mode.drive_for(left.setpoint_um));
            let kept = (-mode.sigma * (right.t_s - left.t_s)).exp();
            let (lowest, highest) = (level * kept, strongest + (level - strongest) * kept);
            // The controller does not know the setpoint of the right row before its instant.
            let next = left.setpoint_um.clamp(lowest.min(highest), highest);
            ideal.falls_with_drive_off |=
                lowest > left.setpoint_um && left.drive_vpp == 0.0 && !left.flags.contains(Flags::SAFE);
            // The envelope crosses an edge of the band on a curve, not on the chord between rows.
            let (low, high) = expectation.band(left.setpoint_um);
            let after = if level < low && low < next {
                Some(((strongest - level) / (strongest - low), low))
            } else if next < high && high < level {
                Some((level / high, high))
            } else {
                None
            };
            if let Some((factor, edge)) = after {
                let t_s = left.t_s + factor.ln() / mode.sigma;
                ideal.rows.push(with_amplitude(&Row { t_s: t_s.clamp(left.t_s, right.t_s), ..*left }, edge));
            }
            level = next;
            ideal.rows.push(with_amplitude(right, level));
        }
        Some(ideal)
    }
}

fn with_amplitude(row: &Row, level: f64) -> Row {
    Row {
        amplitude_um: level,
        wd_um: level,
        wq_um: 0.0,
        sensed_wd_um: level,
        sensed_wq_um: 0.0,
        flags: row.flags - Flags::SAFE,
        ..*row
    }
}
