//! `pll`: the frame is locked to the vibration, the voltage keeps its magnitude (\[13\] of the paper).
//!
//! The paper says of \[13\]: "axis d was attached to W using a phase locked loop, leading to Wq = 0, and the voltage components Vd and Vq were constrained by
//! the condition of a constant voltage amplitude". Assumed: the loop locks the vibration 90° behind the voltage, which is the resonance, and the magnitude
//! is the one that an undisturbed plate needs, `V = setpoint / K1`. In this bench's frame, which hangs on the voltage, the phase to be brought to zero is
//! arg W. A lock at another angle, with which \[13\] can set the amplitude, leaves the resonance; the paper objects to that. This one stays there and leaves the
//! amplitude to the plate.

use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, FrequencyLoop};
use crate::open_loop::OpenLoop;
use crate::pi::PiGains;
use platebench_wire::{Configure, Gains, flags};

/// Below this fraction of the setpoint the phase is noise.
const SMALLEST_AMPLITUDE: f32 = 0.1;

/// State of the phase-locked loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pll {
    drive: OpenLoop,
    frequency: FrequencyLoop,
}

impl Pll {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (_, frequency) = loops::gains(configure);
        let law = Self { drive: OpenLoop::new(configure), frequency: FrequencyLoop::new(frequency, configure) };
        (Law::Pll(law), loops::told(PiGains::NONE, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let Actuation { drive_vpp, mut flags, .. } = self.drive.step(measurement);
        let moves =
            measurement.setpoint_um > 0.0 && measurement.amplitude_um() > SMALLEST_AMPLITUDE * measurement.setpoint_um;
        flags |= if moves {
            self.frequency.step(libm::atan2f(measurement.wq_um, measurement.wd_um))
        } else {
            flags::FREQUENCY_HELD
        };
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }
}
