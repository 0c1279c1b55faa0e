//! Selects the clock from the command line and the rig.

use crate::options::{ClockArg, PacingArg, PlateModeArg};
use platebench_engine::{Clock, Pacing, TimeBase};
use platebench_model::record::ClockKind;
use platebench_model::scenario::Scenario;
use platebench_rig::{Capability, RigSpec, check_baud, rig_syntaxes};

pub(crate) struct ClockRequest<'a> {
    pub(crate) rig: &'a RigSpec,
    pub(crate) clock: Option<ClockArg>,
    pub(crate) time_scale: f64,
    pub(crate) pacing: PacingArg,
    pub(crate) plate_mode: PlateModeArg,
    pub(crate) wire_time: bool,
}

impl<'a> ClockRequest<'a> {
    pub(crate) fn new(rig: &'a RigSpec, clock: Option<ClockArg>) -> Self {
        let (pacing, plate_mode) = (PacingArg::Bench, PlateModeArg::Emulated);
        Self { rig, clock, time_scale: 1.0, pacing, plate_mode, wire_time: false }
    }

    fn default_clock(&self) -> ClockArg {
        match self.rig.default_clock() {
            ClockKind::Lockstep => ClockArg::Lockstep,
            ClockKind::RealTime | ClockKind::RealPlate => ClockArg::RealTime,
        }
    }

    pub(crate) fn resolve(&self) -> Result<Clock, String> {
        let Self { time_scale, wire_time, .. } = *self;
        let pacing = Pacing::from(self.pacing);
        if self.plate_mode == PlateModeArg::Real {
            return self.resolve_real_plate();
        }
        let refuse = |reason: &str| Err(reason.to_owned());
        match self.clock.unwrap_or_else(|| self.default_clock()) {
            ClockArg::Lockstep if time_scale != 1.0 || pacing == Pacing::Target => {
                refuse("--time-scale and --pacing are for --clock real-time")
            }
            ClockArg::Lockstep => Ok(Clock::Lockstep { wire_time }),
            ClockArg::RealTime if let Some(reason) = self.rig.properties().no_real_time => refuse(reason),
            ClockArg::RealTime if wire_time => refuse(
                "--wire-time is for --clock lockstep; in real time line and computing time delay the loop anyway",
            ),
            ClockArg::RealTime if time_scale != 1.0 && pacing == Pacing::Target => {
                refuse("--time-scale needs --pacing bench: a controller's own timer cannot be slowed down")
            }
            ClockArg::RealTime => Ok(Clock::RealTime(TimeBase { time_scale, pacing })),
        }
    }

    /// A controller with a real plate allows one clock only, its own.
    fn resolve_real_plate(&self) -> Result<Clock, String> {
        if !self.rig.has(Capability::RealPlate) {
            let rigs = rig_syntaxes(|rig| rig.capabilities.contains(&Capability::RealPlate));
            return Err(format!("--plate-mode real is for a controller that drives its own plate: --rig {rigs}"));
        }
        let names_clock = self.clock == Some(ClockArg::Lockstep) || self.time_scale != 1.0 || self.wire_time;
        if names_clock || self.pacing == PacingArg::Target {
            let reason = "--plate-mode real uses the controller's own clock: --clock lockstep, --time-scale, --pacing \
                          and --wire-time are for an emulated plate";
            return Err(reason.to_owned());
        }
        Ok(Clock::RealPlate)
    }
}

/// Fails if the serial line is too slow for real time. In lockstep the plate waits for the line.
pub(crate) fn check_line_speed(rig: &RigSpec, clock: Clock, scenarios: &[Scenario]) -> Result<(), String> {
    let Some(baud) = rig.baud() else { return Ok(()) };
    let time_scale = match clock {
        Clock::Lockstep { .. } => return Ok(()),
        Clock::RealTime(time_base) => time_base.time_scale,
        // A period needs 43 bytes of telemetry from a real plate, less than the 48 bytes of sample
        // and command.
        Clock::RealPlate => 1.0,
    };
    for scenario in scenarios {
        check_baud(baud, scenario.controller.period.into(), time_scale)
            .map_err(|error| format!("{}: {error}", scenario.file))?;
    }
    Ok(())
}
