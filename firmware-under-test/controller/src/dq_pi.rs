//! `dq-pi` and `dq-pi-euler`: two PI loops in the d-q frame (section V of the paper).
//!
//! Amplitude: the drive from `Wd_ref − Wd`, plant K1/(1 + τp) (equation 13). Frequency: ω from `Wq/Wd → 0`, plant −τ/(1 + τp)
//! (equation 19); the minus sign turns the loop's error `0 − Wq/Wd` into `+Wq/Wd`.

use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, AmplitudeLoop, FrequencyLoop};
use platebench_wire::{Configure, Gains, flags};

/// The frequency loop rests while Wd is below this fraction of the setpoint: `Wq/Wd` of a plate that hardly moves is noise, and
/// at 10 µs it is 0.34 where the envelope says 0.003.
const SMALLEST_WD: f32 = 0.1;
/// `Wq/Wd` is cut off here: 63°, a detuning of two half bandwidths; beyond it the ratio tells the direction and little else.
const LARGEST_RATIO: f32 = 2.0;

/// State of both loops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DqPi {
    amplitude: AmplitudeLoop,
    frequency: FrequencyLoop,
}

impl DqPi {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, frequency) = loops::gains(configure);
        let law = Self {
            amplitude: AmplitudeLoop::new(amplitude, configure),
            frequency: FrequencyLoop::new(frequency, configure),
        };
        (Law::DqPi(law), loops::told(amplitude, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let (drive_vpp, mut flags) = self.amplitude.step(measurement.setpoint_um - measurement.wd_um);
        flags |= match quadrature_ratio(measurement) {
            Some(ratio) => self.frequency.step(ratio),
            None => flags::FREQUENCY_HELD,
        };
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }
}

/// `Wq/Wd`, cut off; `None` where Wd is too small to divide by.
pub(crate) fn quadrature_ratio(measurement: &Measurement) -> Option<f32> {
    let divisible = measurement.setpoint_um > 0.0 && measurement.wd_um > SMALLEST_WD * measurement.setpoint_um;
    divisible.then(|| (measurement.wq_um / measurement.wd_um).clamp(-LARGEST_RATIO, LARGEST_RATIO))
}
