//! Implements `voltage-only`: a PI controller on |W| at a fixed frequency (\[7\] of the paper).
//!
//! Assumption: the gains are those of `dq-pi`'s amplitude loop. Off resonance the law needs more
//! drive, because `|W|/V = K1/√(1 + (τΔω)²)`.

use crate::design::PiGains;
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, AmplitudeLoop};
use platebench_wire::{Configure, Gains};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoltageOnly {
    amplitude: AmplitudeLoop,
}

impl VoltageOnly {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, _) = loops::loop_gains(configure);
        let law = Self { amplitude: AmplitudeLoop::new(amplitude, configure) };
        (Law::VoltageOnly(law), loops::reported_gains(amplitude, PiGains::NONE, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let (drive_vpp, flags) = self.amplitude.step(measurement.setpoint_um - measurement.amplitude_um());
        Actuation { drive_vpp, frequency_offset_hz: 0.0, flags }
    }
}
