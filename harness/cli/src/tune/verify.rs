//! Verifies gains on a rig: configures the rig, reads the gains back and plays one step.

use crate::board::{BoardArgs, release};
use crate::exit::{Exit, Failure, OrInvalid};
use crate::prompt::TerminalOperator;
use crate::run_plan::{EventSinks, run_plan};
use crate::stdio;
use platebench_design::tuning::design::StepEvaluation;
use platebench_design::tuning::verification::{VerificationStep, gains_match, step_scenario};
use platebench_document::format::with_decimals;
use platebench_document::{Block, Column, Document, Table};
use platebench_engine::{Clock, LiveTap, RunError, RunPlan, configure};
use platebench_lab::boards::BoardOutcome;
use platebench_model::quoted;
use platebench_model::record::{ClockKind, Overrides, RunFolder, TrialRecord};
use platebench_model::scenario::Scenario;
use platebench_report::console;
use platebench_rig::{ConnectOptions, RigSpec, SafeEnd, Session, check_baud};
use platebench_wire::{Gains, LawId};
use schemars::JsonSchema;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

pub(super) struct VerificationConfig<'a> {
    pub(super) board: &'a BoardArgs,
    pub(super) plate: &'a Path,
    pub(super) step: VerificationStep<'a>,
    pub(super) out: Option<&'a Path>,
}

#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RigVerification {
    pub(super) rig: String,
    pub(super) firmware: String,
    pub(super) folder: PathBuf,
    pub(super) settling_ms: Option<f64>,
    pub(super) overshoot_percent: Option<f64>,
    pub(super) peak_drive_vpp: Option<f64>,
    #[serde(skip)]
    pub(super) exit: Exit,
    /// Reason of the exit code.
    #[serde(skip)]
    pub(super) reason: String,
}

impl RigVerification {
    /// Compares the step with the prediction of the design.
    pub(super) fn document(&self, predicted: &StepEvaluation) -> Document {
        let mut table = Table::new([Column::from(""), Column::number("predicted", ""), Column::number("measured", "")]);
        let number = |value| with_decimals(value, 3);
        table.extend(
            [
                ("settling, ms", predicted.settling_ms, self.settling_ms),
                ("overshoot, %", Some(predicted.overshoot_percent), self.overshoot_percent),
                ("peak drive, Vpp", Some(predicted.peak_drive_vpp), self.peak_drive_vpp),
            ]
            .map(|(name, predicted, measured)| [name.to_owned(), number(predicted), number(measured)]),
        );
        let Self { firmware, rig, folder, .. } = self;
        let sentence = format!("{firmware} on {rig} accepted the gains: run folder {}", folder.display());
        Document::new("Step with the gains", vec![Block::Paragraph(sentence), Block::Table(table)])
    }
}

pub(super) fn verify_on_rig(rig: &RigSpec, config: &VerificationConfig<'_>) -> Result<RigVerification, Failure> {
    let reservation = config.board.reserve("tune")?;
    let mut end = BoardOutcome::untouched();
    let verified = play_step(rig, config, &mut end).map_err(Failure::report);
    release(reservation, end)?;
    Ok(verified?)
}

/// Sets `end` to the state of the board after the step.
fn play_step(
    rig: &RigSpec,
    config: &VerificationConfig<'_>,
    end: &mut BoardOutcome,
) -> Result<RigVerification, Failure> {
    let clock = Clock::default_for(rig);
    let step = VerificationStep { real_time: clock.kind() == ClockKind::RealTime, ..config.step };
    if let (true, Some(baud)) = (step.real_time, rig.baud()) {
        let period = Duration::from_micros(u64::from(step.target.period_us));
        check_baud(baud, period, 1.0).or_invalid()?;
    }
    let inputs = tempfile::tempdir().or_invalid()?;
    let scenario = step_scenario(inputs.path(), config.plate, &step).or_invalid()?;
    let (firmware, accepted) = configure_rig(rig, step.law, &scenario, clock, end)?;
    if !gains_match(accepted, step.gains) {
        let message = format!("{firmware} reports the gains {accepted:?}, expected those sent: {:?}", step.gains);
        return Err(Failure::invalid(&message));
    }
    let folder = RunFolder::create(config.out).or_invalid()?;
    let overrides = Overrides { board: config.board.selection.board.clone(), ..Overrides::default() };
    let plan = RunPlan::new(rig, clock, 1, vec![scenario], overrides);
    let played = run_plan(
        Arc::new(plan),
        &folder,
        rig.clone(),
        TerminalOperator::at_plate(false),
        LiveTap::default(),
        EventSinks::none(),
        ConnectOptions::default(),
    );
    let of_run = BoardOutcome::of_run(played.as_ref().map_err(|(error, _)| error), folder.path());
    *end = BoardOutcome { quarantine: end.quarantine.take().or(of_run.quarantine), ..of_run };
    let record = played.map_err(|(error, signal)| match signal {
        Some(signal) => Exit::Signal(signal).into(),
        None => Failure::from(error),
    })?;
    let trial: Option<&TrialRecord> = record.scenarios.first().and_then(|scenario| scenario.trials.first());
    // The rule of `Exit::of_record` also holds for the session that configured the rig.
    let exit = match Exit::of_record(&record) {
        Exit::Passed | Exit::Inconclusive if end.quarantine.is_some() => Exit::Unreachable,
        exit => exit,
    };
    let metric = |name: &str| trial.and_then(|trial| trial.metrics.number(name));
    Ok(RigVerification {
        rig: rig.to_string(),
        firmware,
        folder: folder.path().to_owned(),
        settling_ms: metric("settling_time_ms"),
        overshoot_percent: metric("overshoot_percent"),
        peak_drive_vpp: metric("drive_peak_vpp"),
        exit,
        reason: console::verdict_reason(&record),
    })
}

/// Returns the name of the firmware and the gains that it reports. Leaves the rig at 0 V.
fn configure_rig(
    rig: &RigSpec,
    law: LawId,
    scenario: &Scenario,
    clock: Clock,
    end: &mut BoardOutcome,
) -> Result<(String, Gains), RunError> {
    let mut session = Session::open(clock.connect(rig, &ConnectOptions::default())?)?;
    let accepted = session.start_trial(&configure(scenario, law));
    let [major, minor, patch] = session.identity().version;
    let firmware = format!("{} {major}.{minor}.{patch}", quoted(&session.firmware_name()));
    if session.close() != SafeEnd::Confirmed {
        *end = BoardOutcome::unconfirmed();
        stdio::note(
            "the controller did not confirm 0 V after it was configured, or did not stay there: check the amplifier \
             before you touch the plate",
        );
    }
    Ok((firmware, accepted?))
}
