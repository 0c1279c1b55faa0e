//! `platebench tune`: designs gains for a plate, writes them to a scenario or sends them to a rig.

mod arguments;
mod verify;
mod write;

pub(crate) use arguments::TuneArgs;

use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::options::OutputFormat;
use crate::stdio;
use platebench_design::tuning::design::TuningTarget;
use platebench_design::tuning::verification::{VerificationStep, shortest_decimal};
use platebench_design::tuning::{
    DesignEvaluation, PlateSpread, TuningResult, document, infeasibility_reason, tune as design,
};
use platebench_model::scenario::load::{implausible_values, load_plate, require_no_effects};
use platebench_plate::{Plate, Tier};
use platebench_report::Style;
use platebench_rig::RigSpec;
use platebench_wire::{Gains, LawId};
use serde_json::json;
use std::path::Path;
use verify::{RigVerification, VerificationConfig, verify_on_rig};
use write::write_gains;

pub(crate) fn tune(arguments: &TuneArgs) -> CommandResult {
    let board = arguments.board.selection.find()?;
    let path = arguments.plate.as_ref().or_else(|| board.as_ref()?.plate.as_ref());
    let path = path.ok_or("the board has no plate, expected --plate FILE, or plate in boards.toml").or_invalid()?;
    let send = arguments.send.as_ref().or_else(|| board.as_ref().map(|board| &board.rig));
    let plate = load_plate(path)?;
    require_no_effects(path, &plate, "tune")?;
    let target = arguments.target(&plate).or_invalid()?;
    send.map(RigSpec::check).transpose().or_invalid()?;
    let spread = arguments.spread(path, &plate)?;
    refuse_implausible(path, &plate, arguments.force)?;
    let tuning = design(&target, arguments.discretisation(), &spread).or_invalid()?;
    if arguments.format == OutputFormat::Human {
        stdio::show(&document(&target, &spread, &tuning).to_console(None, Style::default()));
    }
    let (mut exit, mut reason) = if tuning.met {
        (Exit::Passed, "the target is met".to_owned())
    } else {
        (Exit::Failed, format!("the target cannot be met: {}", infeasibility_reason(&target, &tuning)))
    };
    let mut verification = None;
    if let Some(chosen) = &tuning.chosen {
        let gains = chosen.design.firmware_gains(target.period());
        if let Some(scenario) = &arguments.write {
            match write_gains(scenario, &target, gains) {
                Ok(message) => stdio::note(&message),
                Err(fault) => exit = Failure::from(fault).report(),
            }
        }
        if let (Some(rig), Exit::Passed) = (send, exit) {
            let config = VerificationConfig {
                board: &arguments.board,
                plate: path,
                step: VerificationStep { target: &target, law: arguments.law(), gains, real_time: false },
                out: arguments.out.as_deref(),
            };
            match verify_on_rig(rig, &config) {
                Ok(done) => {
                    (exit, reason) = (done.exit, done.reason.clone());
                    verification = Some(done);
                }
                Err(failure) => {
                    (exit, reason) = (failure.report(), "the gains were not verified on the rig".to_owned());
                }
            }
        }
    } else if arguments.write.is_some() || send.is_some() {
        stdio::note("the target is not met: nothing was written or sent");
    }
    match arguments.format {
        OutputFormat::Human => verification.iter().for_each(|done| stdio::show(&comparison_table(&tuning, done))),
        OutputFormat::Json => {
            let verdict = (exit, reason.as_str());
            show_json(&target, &spread, arguments.law(), &tuning, verification.as_ref(), verdict);
        }
    }
    stdio::verdict(exit, &reason, arguments.format);
    Ok(exit)
}

/// Gains for a plate that cannot exist fail on the real plate, so `force` must ask for them.
fn refuse_implausible(path: &Path, plate: &Plate, force: bool) -> Result<(), Failure> {
    let mut faults = implausible_values(path, plate)?;
    if force {
        for fault in &faults {
            stdio::note(&format!("warning: {fault}"));
        }
        return Ok(());
    }
    for fault in &mut faults {
        fault.message += "; --force designs for it nevertheless";
    }
    if faults.is_empty() { Ok(()) } else { Err(faults.into()) }
}

fn comparison_table(tuning: &TuningResult, measured: &RigVerification) -> String {
    let Some(DesignEvaluation { plate: predicted, .. }) = &tuning.chosen else { return String::new() };
    let row = |name: &str, predicted: Option<f64>, measured: Option<f64>| {
        let number = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.3}"));
        format!("  {name:<16} {:>10} {:>10}\n", number(predicted), number(measured))
    };
    format!(
        "\n{} on {} accepted the gains: run folder {}\n  {:<16} {:>10} {:>10}\n{}{}{}",
        measured.firmware,
        measured.rig,
        measured.folder.display(),
        "",
        "predicted",
        "measured",
        row("settling, ms", predicted.settling_ms, measured.settling_ms),
        row("overshoot, %", Some(predicted.overshoot_percent), measured.overshoot_percent),
        row("peak drive, Vpp", Some(predicted.peak_drive_vpp), measured.peak_drive_vpp),
    )
}

fn show_json(
    target: &TuningTarget<'_>,
    spread: &PlateSpread,
    law: LawId,
    tuning: &TuningResult,
    verification: Option<&RigVerification>,
    (exit, reason): (Exit, &str),
) {
    let gains = |evaluation: &DesignEvaluation| {
        let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } =
            evaluation.design.firmware_gains(target.period());
        json!({
            "amplitude_kp": shortest_decimal(amplitude_kp), "amplitude_ki": shortest_decimal(amplitude_ki),
            "frequency_kp": shortest_decimal(frequency_kp), "frequency_ki": shortest_decimal(frequency_ki),
        })
    };
    stdio::show_json(&json!({
        "verdict": exit.word(),
        "reason": reason,
        "plate": target.plate.name,
        "law": law.name(),
        "model": Tier::Modal.name(),
        "demand": {
            "response_ms": target.response * 1e3, "period_ms": target.period() * 1e3, "delay_ms": target.delay * 1e3,
            "setpoint_um": target.setpoint, "force_n": target.force_n, "phase_margin_deg": target.phase_margin_deg,
            "drive_limit_vpp": target.plate.drive_limit_vpp,
        },
        "spread": {
            "gain_percent": spread.gain_percent, "time_constant_percent": spread.time_constant_percent,
            "samples": spread.samples, "seed": spread.seed,
        },
        "gains": tuning.chosen.as_ref().map(gains),
        "possible_gains": tuning.possible.as_ref().map(gains),
        "tuning": tuning,
        "measured": verification.map(|measured| json!({
            "rig": measured.rig, "firmware": measured.firmware, "folder": measured.folder,
            "settling_ms": measured.settling_ms, "overshoot_percent": measured.overshoot_percent,
            "peak_drive_vpp": measured.peak_drive_vpp,
        })),
    }));
}
