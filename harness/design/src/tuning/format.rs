//! Formats a tuning as text.

use crate::tuning::design::TuningTarget;
use crate::tuning::evaluation::{DesignEvaluation, LoopEvaluation, StepEvaluation};
use crate::tuning::spread::{PlateSpread, PlateVariant, Sensitivity, WorstCase};
use crate::tuning::tune::{InfeasibilityCause, TuningResult};
use std::fmt::Write as _;

const NONE: &str = "–";

/// `spread` is the plate spread with which the sensitivity in `tuning` was computed.
pub fn format_tuning(target: &TuningTarget<'_>, spread: &PlateSpread, tuning: &TuningResult) -> String {
    let mut text = format_target(target, tuning);
    text += "\nEquation 24 for the target response time\n";
    text += &format_readings(&tuning.readings);
    match (&tuning.chosen, &tuning.possible) {
        (Some(chosen), _) => {
            text += &format_design("\nThe target is met", chosen);
        }
        (None, possible) => {
            text += "\nThe target cannot be met\n";
            for obstacle in &tuning.obstacles {
                let _ = writeln!(text, "  {}", format_cause(target, obstacle));
            }
            match possible {
                Some(possible) => text += &format_design("\nFastest possible design", possible),
                None => text += "\nNo design of this discretisation settles with this phase margin.\n",
            }
        }
    }
    if let Some(sensitivity) = &tuning.sensitivity {
        text += &format_sensitivity(spread, sensitivity);
    }
    text
}

fn format_target(target: &TuningTarget<'_>, tuning: &TuningResult) -> String {
    let TuningTarget { plate, force_n, setpoint, response, delay, phase_margin_deg, .. } = target;
    let floor = tuning.floor_ms.map_or_else(
        || "the band cannot be reached".to_owned(),
        |floor| format!("the band is reached after {floor:.3} ms at the earliest"),
    );
    format!(
        "{}\nTarget: {setpoint} µm within 5 % in {} ms at {force_n} N; period {} ms, delay {} ms, \
         phase margin {phase_margin_deg}°\n\
         Drive: {:.0} Vpp hold the setpoint; with the limit of {} Vpp {floor}\n",
        plate.name,
        without_rounding_noise(response * 1e3),
        without_rounding_noise(target.period() * 1e3),
        without_rounding_noise(delay * 1e3),
        target.mode().drive_for(*setpoint),
        plate.drive_limit_vpp,
    )
}

fn without_rounding_noise(ms: f64) -> f64 {
    (ms * 1e6).round() / 1e6
}

fn format_optional(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| NONE.to_owned(), |value| format!("{value:.decimals$}"))
}

fn format_settling(step: &StepEvaluation) -> String {
    format_optional(step.settling_ms, 3)
}

fn format_readings(readings: &[DesignEvaluation]) -> String {
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
        let step = |step: &StepEvaluation| {
            let StepEvaluation { overshoot_percent, peak_drive_vpp, .. } = step;
            let settling = step.settling_ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.3} ms"));
            if *overshoot_percent > 999.0 {
                return format!("{settling:>9} {NONE:>9} {NONE:>8}");
            }
            format!("{settling:>9} {overshoot_percent:>7.1} % {peak_drive_vpp:>4.0} Vpp")
        };
        let _ = writeln!(
            text,
            "  {:<26} {} | {} | {:>7.3} {:>6}° {:>6} ms",
            row.discretisation.name(),
            step(&row.linear),
            step(&row.plate),
            row.spectral_radius,
            format_optional(row.amplitude.phase_margin_deg, 1),
            format_optional(row.amplitude.delay_margin_ms, 3),
        );
    }
    text += "  phase: phase margin; delay: delay margin\n";
    text
}

fn format_design(title: &str, figures: &DesignEvaluation) -> String {
    let mut text = format!(
        "{title}: {}, designed for {:.3} ms\n  predicted   settling {} ms, overshoot {:.1} %, peak drive {:.0} Vpp, \
         {} periods at the limit; linear loop {} ms\n",
        figures.discretisation.name(),
        figures.designed_for_ms,
        format_settling(&figures.plate),
        figures.plate.overshoot_percent,
        figures.plate.peak_drive_vpp,
        figures.saturated_periods,
        format_settling(&figures.linear),
    );
    for (name, unit, figures) in
        [("amplitude", "Vpp/µm", &figures.amplitude), ("frequency", "rad/s", &figures.frequency)]
    {
        let LoopEvaluation { kp, ki_per_s, poles, .. } = figures;
        let poles: Vec<_> = poles.iter().map(|[re, im]| format_pole(*re, *im)).collect();
        let _ = writeln!(
            text,
            "  {name:<11} kp {kp:.6} {unit}, ki {ki_per_s:.6} {unit}/s\n  {:<11} poles {}; gain margin {}, \
             phase margin {}°, delay margin {} ms",
            "",
            poles.join(", "),
            format_optional(figures.gain_margin, 2),
            format_optional(figures.phase_margin_deg, 1),
            format_optional(figures.delay_margin_ms, 3),
        );
    }
    text
}

fn format_pole(re: f64, im: f64) -> String {
    if im == 0.0 { format!("{re:.4}") } else { format!("{re:.4}{im:+.4}j") }
}

fn format_sensitivity(spread: &PlateSpread, found: &Sensitivity) -> String {
    let PlateSpread { gain_percent, time_constant_percent, .. } = spread;
    let mut text = format!(
        "\nThese gains on other plates, K1 ±{gain_percent} %, τ ±{time_constant_percent} %\n  \
         {:<24} {:>12} {:>10} {:>7} {:>8} {:>9} {:>8}\n",
        "", "settling, ms", "overshoot", "gain", "phase, °", "delay, ms", "in time"
    );
    let mut row = |name: &str, worst: &WorstCase| {
        let _ = writeln!(
            text,
            "  {name:<24} {:>12} {:>8.1} % {:>7} {:>8} {:>9} {:>8}",
            format_optional(worst.settling_ms, 3),
            worst.overshoot_percent,
            format_optional(worst.gain_margin, 2),
            format_optional(worst.phase_margin_deg, 1),
            format_optional(worst.delay_margin_ms, 3),
            format!("{}/{}", worst.meeting, worst.plates),
        );
    };
    row("worst corner", &found.worst_corner);
    if let Some(worst) = &found.worst_sample {
        row("worst random plate", worst);
    }
    let Some(other_finger) = &found.other_finger else {
        text += "  finger: the plate file has no [finger], so a force changes nothing\n";
        return text;
    };
    let PlateVariant { force_n, plate, gain_margin, phase_margin_deg, delay_margin_ms, .. } = other_finger;
    let _ = writeln!(
        text,
        "  {:<24} {:>12} {:>8.1} % {:>7} {:>8} {:>9}",
        format!("finger of {force_n} N instead"),
        format_settling(plate),
        plate.overshoot_percent,
        format_optional(*gain_margin, 2),
        format_optional(*phase_margin_deg, 1),
        format_optional(*delay_margin_ms, 3),
    );
    text
}

/// Reason why the target cannot be met. Empty if it is met.
pub fn infeasibility_reason(target: &TuningTarget<'_>, tuning: &TuningResult) -> String {
    let causes: Vec<_> = tuning.obstacles.iter().map(|cause| format_cause(target, cause)).collect();
    causes.join("; ")
}

fn format_cause(target: &TuningTarget<'_>, obstacle: &InfeasibilityCause) -> String {
    let limit = target.plate.drive_limit_vpp;
    match obstacle {
        InfeasibilityCause::OutOfReach { needed_vpp } => {
            format!("drive: the setpoint needs {needed_vpp:.0} Vpp, the limit is {limit} Vpp")
        }
        InfeasibilityCause::DriveFloor { floor_ms, needed_vpp } => format!(
            "drive: with {limit} Vpp the band is reached after {floor_ms:.3} ms at the earliest; \
             the target needs {needed_vpp:.1} Vpp"
        ),
        InfeasibilityCause::Period { first_feedback_ms } => format!(
            "period: the first command with feedback acts after {first_feedback_ms:.3} ms, later than the target time"
        ),
        InfeasibilityCause::Delay { boundary_ms } => {
            format!(
                "delay: the gains for this response time (paper, equation 24) are stable up to a delay of \
                 {boundary_ms:.3} ms only; a longer response time permits a longer delay"
            )
        }
        InfeasibilityCause::PhaseMargin { found_deg } => format!(
            "phase margin: designs that are fast enough have {found_deg:.1}°, the target is {}°",
            target.phase_margin_deg
        ),
        InfeasibilityCause::Discretisation => {
            "no design of this discretisation is fast enough at this period and delay".to_owned()
        }
    }
}
