//! Defines the input and output of a control law and calls the configured law.

use crate::bang_bang::BangBang;
use crate::deadbeat::Deadbeat;
use crate::dq_pi::DqPi;
use crate::frequency_only::FrequencyOnly;
use crate::open_loop::OpenLoop;
use crate::pll::Pll;
use crate::voltage_only::VoltageOnly;
use platebench_wire::{Configure, Gains, LawId, Rejection};

/// Sample at a control instant. All amplitudes are peak to peak.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    pub setpoint_um: f32,
    pub wd_um: f32,
    /// Quadrature component; 0 at resonance.
    pub wq_um: f32,
}

impl Measurement {
    pub fn amplitude_um(&self) -> f32 {
        libm::sqrtf(self.wd_um * self.wd_um + self.wq_um * self.wq_um)
    }

    pub fn is_finite(&self) -> bool {
        self.setpoint_um.is_finite() && self.wd_um.is_finite() && self.wq_um.is_finite()
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Actuation {
    /// From 0 to the drive limit.
    pub drive_vpp: f32,
    /// Relative to the start frequency.
    pub frequency_offset_hz: f32,
    pub flags: u8,
}

impl Actuation {
    pub fn is_finite(&self) -> bool {
        self.drive_vpp.is_finite() && self.frequency_offset_hz.is_finite()
    }
}

macro_rules! laws {
    ($($law:ident = $($id:ident)|+,)*) => {
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub enum Law {
            $($law($law),)*
        }

        impl Law {
            fn start(configure: &Configure) -> (Self, Gains) {
                match configure.law {
                    $($(LawId::$id)|+ => $law::design(configure),)*
                }
            }

            pub fn step(&mut self, measurement: &Measurement) -> Actuation {
                match self {
                    $(Self::$law(law) => law.step(measurement),)*
                }
            }
        }
    };
}

// `type of the law = its numbers in the protocol`.
laws! {
    OpenLoop = OpenLoop,
    DqPi = DqPi | DqPiEuler | DqPiFixed,
    VoltageOnly = VoltageOnly,
    FrequencyOnly = FrequencyOnly,
    BangBang = BangBang,
    Pll = Pll,
    Deadbeat = Deadbeat,
}

impl Law {
    /// Returns the law at rest and its gains. Fails with [`Rejection::Value`] if a number is not
    /// finite or out of range.
    pub fn design(configure: &Configure) -> Result<(Self, Gains), Rejection> {
        let positive = [
            configure.gain_um_per_vpp,
            configure.time_constant_s,
            configure.drive_limit_vpp,
            configure.frequency_range_hz,
            configure.frequency_slew_hz,
        ];
        let usable = configure.period_us > 0
            && configure.loop_delay_us <= configure.period_us
            && configure.start_frequency_mhz > 0
            && positive.iter().all(|value| value.is_finite() && *value > 0.0)
            && configure.response_time_s.is_finite()
            && configure.response_time_s >= 0.0;
        if !usable {
            return Err(Rejection::Value);
        }
        let (law, gains) = Self::start(configure);
        let all = [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki];
        if all.iter().all(|gain| gain.is_finite()) { Ok((law, gains)) } else { Err(Rejection::Value) }
    }
}

#[cfg(test)]
pub(crate) mod example {
    use super::*;

    pub(crate) const CONFIGURE: Configure = Configure {
        law: LawId::DqPi,
        paced_by_target: false,
        drives_own_plate: false,
        watchdog_timeout_ms: 0,
        period_us: 1_000,
        loop_delay_us: 0,
        start_frequency_mhz: 32_307_600,
        gain_um_per_vpp: 0.00698,
        time_constant_s: 1.88e-3,
        response_time_s: 1.9e-3,
        drive_limit_vpp: 900.0,
        frequency_range_hz: 200.0,
        frequency_slew_hz: 100.0,
        gains: None,
    };
}

#[cfg(test)]
pub(crate) mod tests;
