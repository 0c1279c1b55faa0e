//! Verifies gains on a rig: configures it, reads the gains back and plays one step.

use super::write::shortest_decimal;
use crate::clock::default_clock;
use crate::exit::Exit;
use crate::options::ClockArg;
use crate::prompt::TerminalOperator;
use crate::run_plan::{EventSinks, run_plan};
use crate::stdio;
use platebench_record::{Overrides, RunFolder, TrialRecord};
use platebench_rig::{ConnectOptions, DEFAULT_REPLY_TIMEOUT, RigSpec, Session, check_baud};
use platebench_runner::{Clock, LiveTap, Pacing, RunError, RunPlan, TimeBase, configure};
use platebench_scenario::{Scenario, load};
use platebench_study::loops::tuning::design::TuningTarget;
use platebench_wire::{Gains, LawId};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Rounding of an f32 integral gain that the controller multiplies by the period and divides again.
const ROUNDING: f32 = 4.0 * f32::EPSILON;

/// The gains to verify.
pub(super) struct VerificationConfig<'a> {
    pub(super) plate: &'a Path,
    pub(super) target: &'a TuningTarget<'a>,
    pub(super) law: LawId,
    pub(super) gains: Gains,
    pub(super) out: Option<&'a Path>,
}

/// The measured step.
#[derive(Debug)]
pub(super) struct RigVerification {
    pub(super) rig: String,
    pub(super) firmware: String,
    pub(super) folder: PathBuf,
    pub(super) settling_ms: Option<f64>,
    pub(super) overshoot_percent: Option<f64>,
    pub(super) peak_drive_vpp: Option<f64>,
    pub(super) exit: Exit,
}

/// Configures the rig, reads the gains back and plays a step.
///
/// # Errors
/// How the program ends; the reason is reported.
pub(super) fn verify_on_rig(rig: &RigSpec, config: &VerificationConfig<'_>) -> Result<RigVerification, Exit> {
    let invalid = |error: &dyn Display| stdio::reject(error);
    let run_error = |error: RunError| {
        stdio::error(&error.to_string());
        Exit::of_error(&error)
    };
    let real_time = default_clock(rig) == ClockArg::RealTime;
    let clock = if real_time {
        Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench })
    } else {
        Clock::Lockstep { wire_time: false }
    };
    if let (true, Some(baud)) = (real_time, rig.baud()) {
        let period = Duration::from_micros(u64::from(config.target.period_us));
        check_baud(baud, period, 1.0).map_err(|error| invalid(&error))?;
    }
    let inputs = tempfile::tempdir().map_err(|error| invalid(&error))?;
    let scenario = step_scenario(inputs.path(), config, real_time).map_err(|error| invalid(&error))?;
    let (firmware, accepted) = configure_rig(rig, config, &scenario, clock).map_err(run_error)?;
    if !gains_match(accepted, config.gains) {
        return Err(invalid(&format!("{firmware} reports other gains than those sent: {accepted:?}")));
    }
    let folder = RunFolder::create(config.out).map_err(|error| invalid(&error))?;
    let plan = RunPlan {
        scenarios: vec![scenario],
        jobs: 1,
        clock,
        own_clock: rig.has_own_clock(),
        rig: rig.to_string(),
        overrides: Overrides::default(),
    };
    let record = run_plan(
        plan,
        &folder,
        rig.clone(),
        TerminalOperator::at_plate(false),
        LiveTap::default(),
        EventSinks::none(),
        DEFAULT_REPLY_TIMEOUT,
    )
    .map_err(|(error, signal)| signal.map_or_else(|| run_error(error), Exit::Signal))?;
    let trial: Option<&TrialRecord> = record.scenarios.first().and_then(|scenario| scenario.trials.first());
    let metric = |name: &str| trial.and_then(|trial| trial.metrics.get(name)?.as_f64());
    Ok(RigVerification {
        rig: rig.to_string(),
        firmware,
        folder: folder.path().to_owned(),
        settling_ms: metric("settling_time_ms"),
        overshoot_percent: metric("overshoot_percent"),
        peak_drive_vpp: metric("drive_peak_vpp"),
        exit: Exit::of_record(&record),
    })
}

/// One step on the tuned plate, written to `folder` so that `judge` can read it from the run folder.
fn step_scenario(
    folder: &Path,
    config: &VerificationConfig<'_>,
    real_time: bool,
) -> Result<Scenario, Box<dyn std::error::Error>> {
    /// The keys that differ from the defaults of a scenario.
    #[derive(Serialize)]
    struct StepScenario {
        title: &'static str,
        plate: &'static str,
        duration_ms: f64,
        controller: StepController,
        profile: BTreeMap<&'static str, f64>,
        expect: [StepExpectation; 3],
    }
    #[derive(Serialize)]
    struct StepController {
        law: &'static str,
        period_ms: f64,
        loop_delay_ms: f64,
        gains: BTreeMap<&'static str, f64>,
    }
    #[derive(Serialize)]
    struct StepExpectation {
        metric: &'static str,
        at_most: f64,
    }
    let TuningTarget { force_n, setpoint, response, period_us, delay, plate, .. } = *config.target;
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = config.gains;
    let gains = [
        ("amplitude_kp", amplitude_kp),
        ("amplitude_ki", amplitude_ki),
        ("frequency_kp", frequency_kp),
        ("frequency_ki", frequency_ki),
    ];
    let period_ms = f64::from(period_us) * 1e-3;
    let scenario = StepScenario {
        title: "Verification of gains",
        plate: "plate.toml",
        duration_ms: f64::from(config.target.horizon()) * period_ms,
        controller: StepController {
            law: config.law.name(),
            period_ms,
            // In real time the rig has its own delay.
            loop_delay_ms: if real_time { 0.0 } else { delay * 1e3 },
            gains: gains.into_iter().map(|(key, gain)| (key, shortest_decimal(gain))).collect(),
        },
        profile: BTreeMap::from([("setpoint_um", setpoint), ("finger_force_n", force_n)]),
        expect: [
            StepExpectation { metric: "settling_time_ms", at_most: response * 1e3 },
            StepExpectation { metric: "overshoot_percent", at_most: 100.0 },
            // The f32 of the wire may be larger than the limit in the file.
            StepExpectation { metric: "drive_peak_vpp", at_most: plate.drive_limit_vpp * (1.0 + 1e-6) },
        ],
    };
    fs::copy(config.plate, folder.join("plate.toml"))?;
    let path = folder.join("tune.toml");
    fs::write(&path, toml::to_string(&scenario)?)?;
    Ok(load(&path, "tune.toml")?)
}

/// The firmware's name and the gains that it reports after its configuration. Leaves the rig at 0 V.
fn configure_rig(
    rig: &RigSpec,
    config: &VerificationConfig<'_>,
    scenario: &Scenario,
    clock: Clock,
) -> Result<(String, Gains), RunError> {
    let mut session = Session::open(clock.connect(rig, &ConnectOptions::default())?)?;
    let accepted = session.start_trial(&configure(scenario, config.law))?;
    let [major, minor, patch] = session.identity().version;
    let firmware = format!("{} {major}.{minor}.{patch}", session.firmware_name());
    if !session.close() {
        stdio::note("the controller did not confirm 0 V after it was configured");
    }
    Ok((firmware, accepted))
}

/// True if the gains agree within the rounding of the controller.
fn gains_match(accepted: Gains, sent: Gains) -> bool {
    let all = |gains: Gains| [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki];
    all(accepted).into_iter().zip(all(sent)).all(|(got, want)| (got - want).abs() <= ROUNDING * want.abs())
}
