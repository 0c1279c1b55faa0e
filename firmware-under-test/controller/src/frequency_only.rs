//! Implements `frequency-only`: at constant voltage, the frequency adjusts the amplitude (\[8\],
//! \[9\] of the paper).
//!
//! The plate is not necessarily at resonance. Assumptions beyond the paper:
//!
//! * The excitation stays above the start frequency, which is assumed to be the resonance. Below
//!   the resonance a rise of the frequency raises the amplitude, so the loop would diverge.
//! * The voltage is half of the drive limit while the setpoint is positive. On the untouched plate,
//!   450 Vpp give 1.0 µm at 250 Hz above the resonance and 3.1 µm at resonance.
//! * A new setpoint starts at the detuning `Δω = √((K1 V / setpoint)² − 1)/τ` of the nominal plate.
//!   Then an integral controller acts on the relative error of |W|. Its gain is `1 − e^(−3 Ts/t_r)`
//!   divided by the slope of the resonance curve, `−d ln|W|/dΔω = τ x/(1 + x²)` with `x = τΔω`.

use crate::design::{FREQUENCY_ONLY_DRIVE_SHARE, PiGains, inverse_slope};
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, Excitation};
use platebench_wire::{Configure, Gains, flags};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrequencyOnly {
    excitation: Excitation,
    drive_vpp: f32,
    /// Amplitude of the nominal plate at resonance.
    highest_um: f32,
    time_constant_s: f32,
    gain: Gain,
    setpoint_um: f32,
}

/// Fraction of the error that a period removes, or the configured gain in rad/s per relative error.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Gain {
    Designed { share: f32 },
    Given { rad_per_unit: f32 },
}

impl FrequencyOnly {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let period = loops::period_s(configure);
        let drive_vpp = FREQUENCY_ONLY_DRIVE_SHARE * configure.drive_limit_vpp;
        let (gain, integral_per_period) = if let Some(gains) = configure.gains {
            let rad_per_unit = gains.frequency_ki * period;
            (Gain::Given { rad_per_unit }, rad_per_unit)
        } else {
            let share = 1.0 - loops::closed_loop_pole(configure);
            // The slope depends on the detuning. The reported gain is that at one half bandwidth,
            // at which the slope is steepest.
            (Gain::Designed { share }, share * inverse_slope(1.0, configure.time_constant_s))
        };
        let law = Self {
            excitation: Excitation::new(configure),
            drive_vpp,
            highest_um: drive_vpp * configure.gain_um_per_vpp,
            time_constant_s: configure.time_constant_s,
            gain,
            setpoint_um: 0.0,
        };
        let frequency = PiGains { proportional: 0.0, integral_per_period };
        (Law::FrequencyOnly(law), loops::reported_gains(PiGains::NONE, frequency, period))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let setpoint_um = measurement.setpoint_um;
        if setpoint_um <= 0.0 {
            self.setpoint_um = 0.0;
            let frequency_offset_hz = self.excitation.offset_hz();
            return Actuation { drive_vpp: 0.0, frequency_offset_hz, flags: flags::FREQUENCY_HELD };
        }
        let ratio = self.highest_um / setpoint_um;
        // τΔω at which the amplitude of the nominal plate equals the setpoint.
        let nominal = libm::sqrtf((ratio * ratio - 1.0).max(0.0));
        let flags = if setpoint_um == self.setpoint_um {
            let error = 1.0 - measurement.amplitude_um() / setpoint_um;
            let rad_per_unit = match self.gain {
                Gain::Designed { share } => share * inverse_slope(nominal, self.time_constant_s),
                Gain::Given { rad_per_unit } => rad_per_unit,
            };
            let offset = self.excitation.offset_rad() - rad_per_unit * error;
            let at_resonance = if offset < 0.0 { flags::FREQUENCY_LIMITED } else { 0 };
            self.excitation.move_to(offset.max(0.0)) | at_resonance
        } else {
            self.excitation.move_to(nominal / self.time_constant_s)
        };
        self.setpoint_um = setpoint_um;
        Actuation { drive_vpp: self.drive_vpp, frequency_offset_hz: self.excitation.offset_hz(), flags }
    }
}
