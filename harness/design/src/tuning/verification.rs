//! Writes the scenario that verifies gains on a rig.

use crate::tuning::design::TuningTarget;
use platebench_model::input;
use platebench_model::scenario::{Diagnostic, Scenario, load};
use platebench_model::trace::write_atomically;
use platebench_wire::{Gains, LawId};
use serde_json::json;
use std::io;
use std::path::Path;

/// Relative rounding error of an f32 gain that the controller multiplies by the period and divides.
const ROUNDING: f32 = 4.0 * f32::EPSILON;
/// Largest relative difference of the measured peak drive from the prediction, in lockstep. The
/// firmware's own law stays within 0.1 % (`docs/tuning.md`, validation).
const MAX_DRIVE_DIFFERENCE: f64 = 0.1;

#[derive(Debug, Clone, Copy)]
pub struct VerificationStep<'a> {
    pub target: &'a TuningTarget<'a>,
    pub law: LawId,
    pub gains: Gains,
    /// Predicted peak of the drive, Vpp.
    pub peak_drive_vpp: f64,
    pub real_time: bool,
}

#[derive(Debug, thiserror::Error)]
pub enum VerificationError {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error(transparent)]
    Toml(#[from] toml::ser::Error),
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
}

/// Writes the scenario of a step on the tuned plate to `folder`, where `report --rejudge` can read it.
pub fn step_scenario(folder: &Path, plate: &Path, step: &VerificationStep<'_>) -> Result<Scenario, VerificationError> {
    let TuningTarget { force_n, setpoint, response, period_us, delay, plate: tuned, .. } = *step.target;
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = step.gains;
    let period_ms = f64::from(period_us) * 1e-3;
    // On the wire, f32 rounding may raise the drive slightly above the limit in the file.
    let limit = tuned.drive_limit_vpp * (1.0 + 1e-6);
    let [least, most] =
        [1.0 - MAX_DRIVE_DIFFERENCE, 1.0 + MAX_DRIVE_DIFFERENCE].map(|share| step.peak_drive_vpp * share);
    let drive = if step.real_time {
        // The delay of the line changes the step.
        json!({ "metric": "drive_peak_vpp", "at_most": limit })
    } else {
        // Another peak means that the controller does not use the gains that it confirmed.
        json!({ "metric": "drive_peak_vpp", "within": [least, most.min(limit)] })
    };
    let content = json!({
        "title": "Verification of gains",
        "plate": "plate.toml",
        "duration_ms": f64::from(step.target.horizon()) * period_ms,
        "controller": {
            "law": step.law.name(),
            "period_ms": period_ms,
            // In real time the rig has its own delay, so the scenario adds none.
            "loop_delay_ms": if step.real_time { 0.0 } else { delay * 1e3 },
            "gains": {
                "amplitude_ki": shortest_decimal(amplitude_ki),
                "amplitude_kp": shortest_decimal(amplitude_kp),
                "frequency_ki": shortest_decimal(frequency_ki),
                "frequency_kp": shortest_decimal(frequency_kp),
            },
        },
        "profile": { "finger_force_n": force_n, "setpoint_um": setpoint },
        "expect": [
            { "metric": "settling_time_ms", "at_most": response * 1e3 },
            { "metric": "overshoot_percent", "at_most": 100.0 },
            drive,
        ],
    });
    // `-` is standard input, which the command line has read before.
    write_atomically(&folder.join("plate.toml"), &input::read(plate)?)?;
    let path = folder.join("tune.toml");
    write_atomically(&path, toml::to_string(&content)?.as_bytes())?;
    load(&path, "tune.toml").map_err(|fault| VerificationError::Scenario(Box::new(fault)))
}

pub fn gains_match(accepted: Gains, sent: Gains) -> bool {
    let all = |gains: Gains| [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki];
    all(accepted).into_iter().zip(all(sent)).all(|(got, want)| (got - want).abs() <= ROUNDING * want.abs())
}

/// Shortest decimal that parses back to the same f32.
pub fn shortest_decimal(gain: f32) -> f64 {
    gain.to_string().parse().unwrap_or_else(|_| f64::from(gain))
}
