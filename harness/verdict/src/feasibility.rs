//! Whether any controller could have met a demand, given the amplifier's limits.
//!
//! The trial is played once more by a controller that nobody can build: it always drives at resonance, knows the plate, and brings the amplitude to
//! the setpoint as fast as the amplifier lets it. What this one misses, nobody can meet. Its amplitude follows the envelope exactly between two rows:
//! `W' = −σ W + b V` with V at the limit where W has to rise, and 0 where it has to fall.

use crate::metrics::{self, Measure};
use crate::record::Telemetry;
use platebench_plate::{Plant, Time};
use platebench_scenario::{Expectation, Metric, Scenario};
use platebench_trace::{Flags, Row};

/// Why the demand could not be met in this trial by any controller; `None` where it could. Only a trial whose drive was at its limit is excused.
pub fn excuse(scenario: &Scenario, expectation: &Expectation, plant: &Plant, rows: &[Row]) -> Option<String> {
    if !is_bound_by_drive(expectation.metric) || matches!(expectation.signal, "wq_um" | "sensed_wq_um") {
        return None;
    }
    let limit = scenario.plate.drive_limit_vpp;
    let Ideal { rows: ideal, fell_at_rest, needed } = Ideal::of(expectation, plant, rows, limit)?;
    if !fell_at_rest && !rows.iter().any(|row| row.flags.contains(Flags::SATURATED)) {
        return None;
    }
    // The ideal's amplitude is known at all times, also where the controller's is known at its samples only.
    let plain = Expectation { signal: "amplitude_um", ..expectation.clone() };
    let best = metrics::measure(&plain, &ideal, &Telemetry::default());
    let (lowest, highest) = expectation.limit.range();
    let out_of_reach = match (expectation.metric, &best) {
        // The ideal is never above the setpoint; how much less than it is the question.
        (Metric::FinalAmplitude, Measure::Value(value)) => *value < lowest,
        // A mean that cannot get to the setpoint goes with the drive, not with the controller.
        (Metric::Repeatability, Measure::Value(ratio)) => *ratio < 100.0 - RATIO_TOLERANCE_PERCENT,
        (Metric::StaticError, Measure::Value(value)) => value.abs() > highest,
        (_, Measure::Value(value) | Measure::Between([value, _])) => *value > highest,
        (_, Measure::Missing(_)) => true,
        (_, Measure::Undefined(_)) => false,
    };
    if !out_of_reach {
        return None;
    }
    let name = expectation.metric;
    let at_best = match best {
        Measure::Value(value) if name == Metric::Repeatability => format!("a mean of {value:.3} % of the setpoint"),
        Measure::Value(value) | Measure::Between([value, _]) => format!("{name} {:.3}", value.abs()),
        Measure::Missing(what) | Measure::Undefined(what) => format!("a signal that {what}"),
    };
    Some(if needed > limit {
        format!("holding the setpoint needs {needed:.0} Vpp, the amplifier gives {limit:.0} Vpp: at best {at_best}")
    } else {
        format!("from 0 to {limit:.0} Vpp no controller does better than {at_best}")
    })
}

/// True for what a drive that is at its limit can spoil.
pub(crate) const fn is_bound_by_drive(metric: Metric) -> bool {
    matches!(
        metric,
        Metric::SettlingTime
            | Metric::RecoveryTime
            | Metric::PeakDeviation
            | Metric::StaticError
            | Metric::Repeatability
            | Metric::FinalAmplitude
    )
}

/// What rounding may take from a mean that is on the setpoint.
const RATIO_TOLERANCE_PERCENT: f64 = 1e-6;

/// The trial as the best of all controllers would have played it.
struct Ideal {
    rows: Vec<Row>,
    /// The amplitude had to fall faster than the plate forgets, while the drive was indeed at 0.
    fell_at_rest: bool,
    /// The highest drive that holding the setpoint at resonance takes at any row, Vpp.
    needed: f64,
}

impl Ideal {
    fn of(expectation: &Expectation, plant: &Plant, rows: &[Row], limit: f64) -> Option<Self> {
        let first = rows.first()?;
        let mut level = first.amplitude_um;
        let mut ideal = Self { rows: vec![with_level(first, level)], fell_at_rest: false, needed: 0.0 };
        for pair in rows.windows(2) {
            let [left, right] = pair else { continue };
            let (start, end) = (Time::from_seconds(left.t_s)?, Time::from_seconds(right.t_s)?);
            let mode = plant.mode_at(start.midpoint(end));
            let strongest = limit / mode.drive_for(1.0);
            ideal.needed = ideal.needed.max(mode.drive_for(left.setpoint_um));
            let kept = (-mode.sigma * (right.t_s - left.t_s)).exp();
            let (lowest, highest) = (level * kept, strongest + (level - strongest) * kept);
            // Between two rows the setpoint is where the left one says; what comes with the right row is not known yet.
            let next = left.setpoint_um.clamp(lowest.min(highest), highest);
            ideal.fell_at_rest |=
                lowest > left.setpoint_um && left.drive_vpp == 0.0 && !left.flags.contains(Flags::SAFE);
            // An edge of the band is crossed on a curve, not on the chord between the rows.
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
                ideal.rows.push(with_level(&Row { t_s: t_s.clamp(left.t_s, right.t_s), ..*left }, edge));
            }
            level = next;
            ideal.rows.push(with_level(right, level));
        }
        Some(ideal)
    }
}

fn with_level(row: &Row, level: f64) -> Row {
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
