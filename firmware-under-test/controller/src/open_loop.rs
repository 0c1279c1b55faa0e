//! Implements `open-loop`: applies the drive of an undisturbed plate at a fixed frequency.

use crate::design::PiGains;
use crate::law::{Actuation, Law, Measurement};
use crate::loops;
use platebench_wire::{Configure, Gains, flags};

/// Constant drive `V = setpoint / K1`, from equation 13 in the steady state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpenLoop {
    gain_um_per_vpp: f32,
    drive_limit_vpp: f32,
}

impl OpenLoop {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        (
            Law::OpenLoop(Self::new(configure)),
            loops::reported_gains(PiGains::NONE, PiGains::NONE, loops::period_s(configure)),
        )
    }

    pub(crate) fn new(configure: &Configure) -> Self {
        Self { gain_um_per_vpp: configure.gain_um_per_vpp, drive_limit_vpp: configure.drive_limit_vpp }
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let unlimited = measurement.setpoint_um / self.gain_um_per_vpp;
        let drive_vpp = unlimited.clamp(0.0, self.drive_limit_vpp);
        let flags = if drive_vpp == unlimited { 0 } else { flags::SATURATED };
        Actuation { drive_vpp, frequency_offset_hz: 0.0, flags }
    }
}
