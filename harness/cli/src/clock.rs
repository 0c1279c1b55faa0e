//! How time passes: what the command line means by it, and what goes with which rig.

use crate::args::{Clock, Pacing, PlateMode, Run};
use crate::exit::Exit;
use crate::output;
use platebench_rig::{RigSpec, check_baud};
use platebench_runner::Pace;
use platebench_scenario::Scenario;
use std::time::Duration;

/// The clock, where clock, rig and what is told to files go together; why not has been shown.
pub(crate) fn checked(arguments: &Run) -> Result<platebench_runner::Clock, Exit> {
    let clock = clock(arguments).map_err(|what| {
        output::error(what);
        Exit::Invalid
    })?;
    arguments.rig.check().map_err(|error| {
        output::error(&error.to_string());
        Exit::Invalid
    })?;
    arguments.told.check().map_err(|what| {
        output::error(&what);
        Exit::Invalid
    })?;
    Ok(clock)
}

/// The clock of a rig where none is named.
pub(crate) fn default_clock(rig: &RigSpec) -> Clock {
    match rig {
        RigSpec::Serial { .. } | RigSpec::Probe { port: Some(_), .. } => Clock::RealTime,
        RigSpec::Hosted | RigSpec::Emulated(_) | RigSpec::Exec(_) | RigSpec::Probe { port: None, .. } => {
            Clock::Lockstep
        }
    }
}

/// The clock that the command line means; why it cannot be meant where it cannot.
pub(crate) fn clock(arguments: &Run) -> Result<platebench_runner::Clock, &'static str> {
    let pacing = match arguments.pacing {
        Pacing::Bench => platebench_runner::Pacing::Bench,
        Pacing::Target => platebench_runner::Pacing::Target,
    };
    let time_scale = arguments.time_scale;
    if arguments.plate_mode == PlateMode::Real {
        return real_plate(arguments);
    }
    match arguments.clock.unwrap_or(default_clock(&arguments.rig)) {
        Clock::Lockstep if time_scale != 1.0 || arguments.pacing == Pacing::Target => {
            Err("--time-scale and --pacing are for --clock real-time")
        }
        Clock::Lockstep => Ok(platebench_runner::Clock::Lockstep { wire_time: arguments.wire_time }),
        Clock::RealTime if !arguments.rig.keeps_real_time() => Err(
            "RTT through a debug probe does not keep real time: use --clock lockstep or name the board's serial port, --rig probe:CHIP,port=PORT[@BAUD]",
        ),
        Clock::RealTime if arguments.wire_time => {
            Err("--wire-time is for --clock lockstep; in real time every microsecond acts anyway")
        }
        Clock::RealTime if time_scale != 1.0 && pacing == platebench_runner::Pacing::Target => {
            Err("--time-scale needs --pacing bench: a controller's own timer cannot be slowed down")
        }
        Clock::RealTime => Ok(platebench_runner::Clock::RealTime(Pace { time_scale, pacing })),
    }
}

/// A real plate has one clock, the controller's.
fn real_plate(arguments: &Run) -> Result<platebench_runner::Clock, &'static str> {
    if !matches!(arguments.rig, RigSpec::Serial { .. } | RigSpec::Exec(_)) {
        return Err(
            "--plate-mode real is for a controller with a plate of its own: --rig serial:PORT[@BAUD] or exec:COMMAND",
        );
    }
    let asks_for_another =
        arguments.clock == Some(Clock::Lockstep) || arguments.time_scale != 1.0 || arguments.wire_time;
    if asks_for_another || arguments.pacing == Pacing::Target {
        return Err(
            "--plate-mode real has the controller's own clock: --clock lockstep, --time-scale, --pacing and --wire-time are for an emulated plate",
        );
    }
    Ok(platebench_runner::Clock::OwnPlate)
}

/// Whether the line can carry what the scenarios ask for, in real time; in lockstep the plate waits for it.
pub(crate) fn fast_enough(
    arguments: &Run,
    clock: platebench_runner::Clock,
    scenarios: &[Scenario],
) -> Result<(), String> {
    let Some(baud) = arguments.rig.baud() else { return Ok(()) };
    let time_scale = match clock {
        platebench_runner::Clock::Lockstep { .. } => return Ok(()),
        platebench_runner::Clock::RealTime(pace) => pace.time_scale,
        // Telemetry takes 43 bytes a period, a sample and its command 48.
        platebench_runner::Clock::OwnPlate => 1.0,
    };
    for scenario in scenarios {
        let period = Duration::from_nanos(scenario.controller.period.as_nanos());
        check_baud(baud, period, time_scale).map_err(|error| format!("{}: {error}", scenario.file))?;
    }
    Ok(())
}
