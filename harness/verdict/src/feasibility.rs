//! Whether any controller could have met a demand, given the amplifier's limit.

use crate::metrics::setpoint_steps;
use platebench_plate::{Plant, Time};
use platebench_scenario::{Expectation, Metric, Scenario};
use platebench_trace::{Flags, Row};

/// Why the demand could not be met in this trial by any controller; `None` where it could. Only a trial whose drive was at its limit is excused.
pub fn excuse(scenario: &Scenario, expectation: &Expectation, plant: &Plant, rows: &[Row]) -> Option<String> {
    if !rows.iter().any(|row| row.flags.contains(Flags::SATURATED)) {
        return None;
    }
    let limit = scenario.plate.drive_limit_vpp;
    let needed = steady_drive(expectation, plant, rows)?;
    if needed > limit {
        return Some(format!("holding the setpoint needs {needed:.0} Vpp, the amplifier gives {limit:.0} Vpp"));
    }
    let (_, longest_ms) = expectation.limit.range();
    let floor =
        settling_floor(expectation, plant, rows, limit).filter(|_| expectation.metric == Metric::SettlingTime)?;
    (floor * 1e3 > longest_ms).then(|| {
        format!("at {limit:.0} Vpp no controller is faster than {:.3} ms, {longest_ms} ms are demanded", floor * 1e3)
    })
}

/// The highest drive that holding the setpoint at resonance takes at any row that the metric looks at, Vpp.
fn steady_drive(expectation: &Expectation, plant: &Plant, rows: &[Row]) -> Option<f64> {
    let from = match expectation.metric {
        Metric::StaticError | Metric::Repeatability => expectation.window.from,
        Metric::FinalAmplitude | Metric::QuadratureRatio | Metric::FrequencyError => {
            Time::from_seconds(rows.last()?.t_s)?
        }
        Metric::SettlingTime | Metric::RecoveryTime | Metric::PeakDeviation | Metric::Overshoot => {
            expectation.from.unwrap_or(Time::ZERO)
        }
        Metric::DrivePeak | Metric::Saturated | Metric::LoopDelay | Metric::Overruns => return None,
    };
    let looked_at = rows.iter().skip_while(|row| row.t_s < from.seconds());
    let drives =
        looked_at.filter_map(|row| Some(plant.mode_at(Time::from_seconds(row.t_s)?).drive_for(row.setpoint_um)));
    drives.reduce(f64::max)
}

/// The shortest time in s from the setpoint step to the band's nearer edge with the drive at its limit, or at 0 where the amplitude has to fall.
fn settling_floor(expectation: &Expectation, plant: &Plant, rows: &[Row], limit: f64) -> Option<f64> {
    let steps = setpoint_steps(rows);
    let passed = |step: &&usize| {
        rows.get(**step).is_some_and(|row| expectation.from.is_none_or(|from| row.t_s <= from.seconds()))
    };
    let step = match expectation.from {
        None => steps.first(),
        Some(_) => steps.iter().rfind(passed).or_else(|| steps.first()),
    };
    let row = rows.get(*step?)?;
    let mode = plant.mode_at(Time::from_seconds(row.t_s)?);
    let (low, high) = expectation.band(row.setpoint_um);
    let strongest = limit / mode.drive_for(1.0);
    let (rest, edge) = if row.amplitude_um < low { (strongest, low) } else { (0.0, high) };
    if (low..=high).contains(&row.amplitude_um) {
        return None;
    }
    let share = (rest - row.amplitude_um) / (rest - edge);
    (share > 1.0).then(|| share.ln() / mode.sigma)
}
