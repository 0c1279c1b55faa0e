//! Implements `bang-bang`: a PI loop controls the amplitude, and the frequency moves by a fixed
//! step per period (\[10\], \[11\] of the paper).
//!
//! The paper describes \[10\] as good close to the resonance and slow "with unsuited initial
//! condition". Assumptions: the amplitude loop is that of `voltage-only`. The sign of Wq gives the
//! direction (Wq/Wd → −τΔω, equation 19). The step is a twentieth of the plate's half bandwidth,
//! `1/(20 τ)` or 4.2 Hz, which changes the amplitude by 0.1 %. If the resonance at the start is
//! shifted by 9 K (545 rad/s), the law needs twenty periods to reach it.

use crate::design::PiGains;
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, AmplitudeLoop, Excitation};
use platebench_wire::{Configure, Gains, flags};

const STEPS_PER_HALF_BANDWIDTH: f32 = 20.0;
/// Fraction of the setpoint. Below this amplitude the sign of Wq is mostly noise.
const MIN_AMPLITUDE_SHARE: f32 = 0.1;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BangBang {
    amplitude: AmplitudeLoop,
    excitation: Excitation,
    step_rad: f32,
}

impl BangBang {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, _) = loops::loop_gains(configure);
        let law = Self {
            amplitude: AmplitudeLoop::new(amplitude, configure),
            excitation: Excitation::new(configure),
            step_rad: 1.0 / (STEPS_PER_HALF_BANDWIDTH * configure.time_constant_s),
        };
        (Law::BangBang(law), loops::reported_gains(amplitude, PiGains::NONE, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let amplitude_um = measurement.amplitude_um();
        let (drive_vpp, mut flags) = self.amplitude.step(measurement.setpoint_um - amplitude_um);
        flags |= if measurement.setpoint_um > 0.0 && amplitude_um > MIN_AMPLITUDE_SHARE * measurement.setpoint_um {
            let step = if measurement.wq_um > 0.0 { self.step_rad } else { -self.step_rad };
            self.excitation.move_to(self.excitation.offset_rad() + step)
        } else {
            flags::FREQUENCY_HELD
        };
        Actuation { drive_vpp, frequency_offset_hz: self.excitation.offset_hz(), flags }
    }
}
