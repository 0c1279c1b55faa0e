//! A tuning in words, as a terminal shows it.

use crate::tuning::design::Demand;
use crate::tuning::spread::{Other, Sensitivity, Spread, Worst};
use crate::tuning::{Figures, LoopFigures, Obstacle, StepFigures, Tuning};
use std::fmt::Write as _;

const NONE: &str = "–";

/// All of it. `spread` is what the sensitivity was taken over.
pub fn text(demand: &Demand<'_>, spread: &Spread, tuning: &Tuning) -> String {
    let mut text = head(demand, tuning);
    text += "\nEquation 24 for the demanded response\n";
    text += &readings(&tuning.readings);
    match (&tuning.chosen, &tuning.possible) {
        (Some(chosen), _) => {
            text += &design("\nThe demand is met", chosen);
        }
        (None, possible) => {
            text += "\nThe demand cannot be met\n";
            for obstacle in &tuning.obstacles {
                let _ = writeln!(text, "  {}", reason(demand, obstacle));
            }
            match possible {
                Some(possible) => text += &design("\nWhat would be possible, as fast as there is", possible),
                None => text += "\nNo design of this kind settles with that much phase to spare.\n",
            }
        }
    }
    if let Some(sensitivity) = &tuning.sensitivity {
        text += &self::sensitivity(spread, sensitivity);
    }
    text
}

fn head(demand: &Demand<'_>, tuning: &Tuning) -> String {
    let Demand { plate, force_n, setpoint, response, delay, phase_margin_deg, .. } = demand;
    let floor = tuning.floor_ms.map_or_else(
        || "the band is never reached".to_owned(),
        |floor| format!("the band is reached after {floor:.3} ms at the soonest"),
    );
    format!(
        "{}\nDemand: {setpoint} µm within 5 % in {} ms at {force_n} N; period {} ms, delay {} ms, phase margin {phase_margin_deg}°\n\
         Drive: {:.0} Vpp hold it; with the limit of {} Vpp {floor}\n",
        plate.name,
        rounded(response * 1e3),
        rounded(demand.period() * 1e3),
        rounded(delay * 1e3),
        demand.mode().drive_for(*setpoint),
        plate.drive_limit_vpp,
    )
}

/// Without the noise of a conversion from seconds.
fn rounded(ms: f64) -> f64 {
    (ms * 1e6).round() / 1e6
}

fn optional(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| NONE.to_owned(), |value| format!("{value:.decimals$}"))
}

fn settling(step: &StepFigures) -> String {
    optional(step.settling_ms, 3)
}

fn readings(readings: &[Figures]) -> String {
    let mut text = format!(
        "  {:<26} {:^28} | {:^28} | {:>7} {:>7} {:>9}\n  {:<26} {:>9} {:>9} {:>8} | {:>9} {:>9} {:>8} |\n",
        "",
        "linear loop, no limit",
        "|W| of the plate",
        "radius",
        "phase",
        "delay",
        "",
        "settling",
        "over",
        "drive",
        "settling",
        "over",
        "drive"
    );
    for row in readings {
        let step = |step: &StepFigures| {
            let StepFigures { overshoot_percent, peak_drive_vpp, .. } = step;
            let settling = step.settling_ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.3} ms"));
            // What grows without end has no figures.
            if *overshoot_percent > 999.0 {
                return format!("{settling:>9} {NONE:>9} {NONE:>8}");
            }
            format!("{settling:>9} {overshoot_percent:>7.1} % {peak_drive_vpp:>4.0} Vpp")
        };
        let _ = writeln!(
            text,
            "  {:<26} {} | {} | {:>7.3} {:>6}° {:>6} ms",
            row.reading.name(),
            step(&row.linear),
            step(&row.plate),
            row.spectral_radius,
            optional(row.amplitude.phase_margin_deg, 1),
            optional(row.amplitude.delay_margin_ms, 3),
        );
    }
    text += "  phase: margin; delay: what may be added to the present one\n";
    text
}

fn design(title: &str, figures: &Figures) -> String {
    let mut text = format!(
        "{title}: {}, designed for {:.3} ms\n  predicted   settling {} ms, overshoot {:.1} %, peak drive {:.0} Vpp, {} periods at the limit; the linear loop {} ms\n",
        figures.reading.name(),
        figures.designed_for_ms,
        settling(&figures.plate),
        figures.plate.overshoot_percent,
        figures.plate.peak_drive_vpp,
        figures.saturated_periods,
        settling(&figures.linear),
    );
    for (name, unit, figures) in
        [("amplitude", "Vpp/µm", &figures.amplitude), ("frequency", "rad/s", &figures.frequency)]
    {
        let LoopFigures { kp, ki_per_s, poles, .. } = figures;
        let poles: Vec<_> = poles.iter().map(|[re, im]| pole(*re, *im)).collect();
        let _ = writeln!(
            text,
            "  {name:<11} kp {kp:.6} {unit}, ki {ki_per_s:.6} {unit}/s\n  {:<11} poles {}; gain margin {}, phase margin {}°, delay margin {} ms",
            "",
            poles.join(", "),
            optional(figures.gain_margin, 2),
            optional(figures.phase_margin_deg, 1),
            optional(figures.delay_margin_ms, 3),
        );
    }
    text
}

fn pole(re: f64, im: f64) -> String {
    if im == 0.0 { format!("{re:.4}") } else { format!("{re:.4}{im:+.4}j") }
}

fn sensitivity(spread: &Spread, found: &Sensitivity) -> String {
    let Spread { gain_percent, time_constant_percent, .. } = spread;
    let mut text = format!(
        "\nThese gains on other plates, K1 ±{gain_percent} %, τ ±{time_constant_percent} %\n  {:<24} {:>12} {:>10} {:>7} {:>8} {:>9} {:>8}\n",
        "", "settling, ms", "overshoot", "gain", "phase, °", "delay, ms", "in time"
    );
    let mut row = |name: &str, worst: &Worst| {
        let _ = writeln!(
            text,
            "  {name:<24} {:>12} {:>8.1} % {:>7} {:>8} {:>9} {:>8}",
            optional(worst.settling_ms, 3),
            worst.overshoot_percent,
            optional(worst.gain_margin, 2),
            optional(worst.phase_margin_deg, 1),
            optional(worst.delay_margin_ms, 3),
            format!("{}/{}", worst.meeting, worst.plates),
        );
    };
    row("worst corner", &found.worst_corner);
    if let Some(worst) = &found.worst_sample {
        row("worst drawn between", worst);
    }
    let Other { force_n, plate, gain_margin, phase_margin_deg, delay_margin_ms, .. } = &found.other_finger;
    let _ = writeln!(
        text,
        "  {:<24} {:>12} {:>8.1} % {:>7} {:>8} {:>9}",
        format!("finger of {force_n} N instead"),
        settling(plate),
        plate.overshoot_percent,
        optional(*gain_margin, 2),
        optional(*phase_margin_deg, 1),
        optional(*delay_margin_ms, 3),
    );
    text
}

fn reason(demand: &Demand<'_>, obstacle: &Obstacle) -> String {
    let limit = demand.plate.drive_limit_vpp;
    match obstacle {
        Obstacle::OutOfReach { needed_vpp } => {
            format!("drive: {needed_vpp:.0} Vpp hold the setpoint, the limit is {limit} Vpp: no controller gets there")
        }
        Obstacle::DriveFloor { floor_ms, needed_vpp } => format!(
            "drive: with {limit} Vpp no controller is in the band before {floor_ms:.3} ms; in time it would take {needed_vpp:.1} Vpp"
        ),
        Obstacle::Period { first_feedback_ms } => format!(
            "period: the first command that knows of a measurement acts after {first_feedback_ms:.3} ms, when the response should be over"
        ),
        Obstacle::Delay { boundary_ms } => {
            format!("delay: equation 24 for this response is stable up to {boundary_ms:.3} ms only")
        }
        Obstacle::PhaseMargin { found_deg } => format!(
            "phase margin: what is fast enough leaves {found_deg:.1}°, {}° were asked for",
            demand.phase_margin_deg
        ),
        Obstacle::Reading => "period and delay: no design of this kind is that fast with them".to_owned(),
    }
}
