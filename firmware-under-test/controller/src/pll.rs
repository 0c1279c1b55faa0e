//! Implements `pll`: locks the phase to the resonance at a constant voltage (\[13\] of the paper).
//!
//! Assumptions: at resonance the vibration lags the voltage by 90°, and the loop holds this phase.
//! The voltage is that of an undisturbed plate, `V = setpoint / K1`. W is given in a frame that
//! rotates with the voltage, and at resonance arg W is 0. The law does not control the amplitude.

use crate::design::PiGains;
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, FrequencyLoop};
use crate::open_loop::OpenLoop;
use platebench_wire::{Configure, Gains, flags};

/// Fraction of the setpoint. Below this amplitude the measured phase is mostly noise.
const MIN_AMPLITUDE_SHARE: f32 = 0.1;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pll {
    drive: OpenLoop,
    frequency: FrequencyLoop,
}

impl Pll {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (_, frequency) = loops::loop_gains(configure);
        let law = Self { drive: OpenLoop::new(configure), frequency: FrequencyLoop::new(frequency, configure) };
        (Law::Pll(law), loops::reported_gains(PiGains::NONE, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let Actuation { drive_vpp, mut flags, .. } = self.drive.step(measurement);
        let moves =
            measurement.setpoint_um > 0.0 && measurement.amplitude_um() > MIN_AMPLITUDE_SHARE * measurement.setpoint_um;
        flags |= if moves {
            self.frequency.step(libm::atan2f(measurement.wq_um, measurement.wd_um))
        } else {
            flags::FREQUENCY_HELD
        };
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }
}
