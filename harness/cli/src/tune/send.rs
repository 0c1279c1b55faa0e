//! Gains to a rig: who is there, whether it takes them, and one step that shows what they do.

use crate::args::Clock;
use crate::clock::default_clock;
use crate::desk::Desk;
use crate::exit::Exit;
use crate::output;
use crate::play::{Audience, play};
use crate::tune::write::shortest;
use platebench_analysis::tuning::design::Demand;
use platebench_rig::{RigSpec, Session, check_baud};
use platebench_runner::{Pace, Pacing, Plan, RunError, RunFolder, Watch, configure};
use platebench_scenario::{Scenario, load};
use platebench_verdict::record::Overrides;
use platebench_verdict::{RunRecord, TrialRecord};
use platebench_wire::{Gains, LawId};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Four roundings of an f32.
const ROUNDING: f32 = 4.0 * f32::EPSILON;

/// What is to be sent.
pub(super) struct Order<'a> {
    pub(super) plate: &'a Path,
    pub(super) demand: &'a Demand<'a>,
    pub(super) law: LawId,
    pub(super) gains: Gains,
    pub(super) out: Option<&'a Path>,
}

/// What the rig did with it.
#[derive(Debug)]
pub(super) struct Verified {
    pub(super) rig: String,
    pub(super) firmware: String,
    pub(super) folder: PathBuf,
    pub(super) settling_ms: Option<f64>,
    pub(super) overshoot_percent: Option<f64>,
    pub(super) peak_drive_vpp: Option<f64>,
    pub(super) exit: Exit,
}

/// Configures the rig, reads back what it took and plays a step. What went wrong has been said where there is only an exit code.
pub(super) fn send(rig: &RigSpec, order: &Order<'_>) -> Result<Verified, Exit> {
    let told = |error: &dyn std::fmt::Display, exit: Exit| {
        output::error(&error.to_string());
        exit
    };
    let run_error = |error: RunError| told(&error, Exit::of_error(&error));
    let real_time = default_clock(rig) == Clock::RealTime;
    if let (true, Some(baud)) = (real_time, rig.baud()) {
        let period = Duration::from_micros(u64::from(order.demand.period_us));
        check_baud(baud, period, 1.0).map_err(|error| told(&error, Exit::Invalid))?;
    }
    let desk = tempfile::tempdir().map_err(|error| told(&error, Exit::Invalid))?;
    let scenario = scenario(desk.path(), order, real_time).map_err(|error| told(&error, Exit::Invalid))?;
    let (firmware, taken) = accept(rig, order, &scenario, real_time).map_err(run_error)?;
    if !same(taken, order.gains) {
        // What it would show says nothing about the gains that were sent.
        return Err(told(&format!("{firmware} says that other gains are in force: {taken:?}"), Exit::Invalid));
    }
    let folder = RunFolder::create(order.out).map_err(|error| told(&error, Exit::Invalid))?;
    let clock = if real_time {
        platebench_runner::Clock::RealTime(Pace { time_scale: 1.0, pacing: Pacing::Bench })
    } else {
        platebench_runner::Clock::Lockstep { wire_time: false }
    };
    let plan = Plan {
        scenarios: vec![scenario],
        jobs: 1,
        clock,
        own_clock: rig.has_own_clock(),
        rig: rig.to_string(),
        overrides: Overrides::default(),
    };
    let record = play(plan, &folder, rig.clone(), Desk::new(false), Watch::default(), Audience::nobody())
        .map_err(|(error, signal)| signal.map_or_else(|| run_error(error), Exit::Signal))?;
    Ok(verified(rig, firmware, folder.path().to_owned(), &record))
}

/// One step on the plate that was tuned for, expected within what was demanded.
fn scenario(desk: &Path, order: &Order<'_>, real_time: bool) -> Result<Scenario, Box<dyn std::error::Error>> {
    let Demand { force_n, setpoint, response, period_us, delay, plate, .. } = *order.demand;
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = order.gains;
    fs::copy(order.plate, desk.join("plate.toml"))?;
    // In real time the rig has a delay of its own.
    let delay_ms = if real_time { 0.0 } else { delay * 1e3 };
    let text = format!(
        "title = \"Verification of gains\"\nplate = \"plate.toml\"\nduration_ms = {:?}\n\n[controller]\nlaw = \"{}\"\nperiod_ms = {:?}\n\
         loop_delay_ms = {delay_ms:?}\n\n[controller.gains]\namplitude_kp = {:?}\namplitude_ki = {:?}\nfrequency_kp = {:?}\nfrequency_ki = {:?}\n\n\
         [profile]\nsetpoint_um = {setpoint:?}\nfinger_force_n = {force_n:?}\n\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = {:?}\n\n\
         [[expect]]\nmetric = \"overshoot_percent\"\nat_most = 100.0\n\n[[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = {:?}\n",
        f64::from(order.demand.horizon()) * f64::from(period_us) * 1e-3,
        order.law.name(),
        f64::from(period_us) * 1e-3,
        shortest(amplitude_kp),
        shortest(amplitude_ki),
        shortest(frequency_kp),
        shortest(frequency_ki),
        response * 1e3,
        // The wire's f32 may lie above the file's number.
        plate.drive_limit_vpp * (1.0 + 1e-6),
    );
    let path = desk.join("tune.toml");
    fs::write(&path, text)?;
    Ok(load(&path, "tune.toml")?)
}

/// Who is there, and the gains that are in force after it was configured; at 0 V afterwards.
fn accept(rig: &RigSpec, order: &Order<'_>, scenario: &Scenario, real_time: bool) -> Result<(String, Gains), RunError> {
    let link = if real_time { rig.connect_in_real_time() } else { rig.connect() };
    let mut session = Session::open(link?)?;
    let taken = session.begin(&configure(scenario, order.law))?;
    let [major, minor, patch] = session.identity().version;
    let firmware = format!("{} {major}.{minor}.{patch}", session.firmware_name());
    if !session.close() {
        output::note("the controller did not confirm 0 V after it was configured");
    }
    Ok((firmware, taken))
}

/// True but for the f32 rounding of an integral gain that was multiplied by the period and divided again.
fn same(taken: Gains, given: Gains) -> bool {
    let all = |gains: Gains| [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki];
    all(taken).into_iter().zip(all(given)).all(|(taken, given)| (taken - given).abs() <= ROUNDING * given.abs())
}

fn verified(rig: &RigSpec, firmware: String, folder: PathBuf, record: &RunRecord) -> Verified {
    let trial: Option<&TrialRecord> = record.scenarios.first().and_then(|scenario| scenario.trials.first());
    let metric = |name: &str| trial.and_then(|trial| trial.metrics.get(name)?.as_f64());
    Verified {
        rig: rig.to_string(),
        firmware,
        folder,
        settling_ms: metric("settling_time_ms"),
        overshoot_percent: metric("overshoot_percent"),
        peak_drive_vpp: metric("drive_peak_vpp"),
        exit: Exit::of_record(record),
    }
}
