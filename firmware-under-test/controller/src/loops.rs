//! Implements the amplitude loop and the frequency loop that most laws share.

use crate::design::{self, PiGains};
use crate::pi::{Pi, Tracking};
use core::f32::consts::TAU;
use platebench_wire::{Configure, Gains, flags};

/// Measured at the drive limit: full tracking (1) settles 16 % above the shortest possible time at
/// 400 Vpp, and no tracking (0) overshoots by 14 % at 340 Vpp. With 0.6 the response settles within
/// 10 % of the shortest time from 300 to 416 Vpp and overshoots by less than 4 %. At 0 V only the
/// damping reduces the amplitude, so tracking is full.
pub(crate) const AMPLITUDE_TRACKING: Tracking = Tracking { low: 1.0, high: 0.6 };

/// Gains of the amplitude loop (plant K1/(1 + τp), equation 13) and of the frequency loop (plant
/// −τ/(1 + τp), equation 19).
pub(crate) fn loop_gains(configure: &Configure) -> (PiGains, PiGains) {
    let period = period_s(configure);
    let (gain, tau) = (configure.gain_um_per_vpp, configure.time_constant_s);
    let design = |gain| PiGains::of_law(configure.law, gain, tau, response_time_s(configure), period);
    let given = |proportional, integral: f32| PiGains { proportional, integral_per_period: integral * period };
    match configure.gains {
        Some(gains) => (given(gains.amplitude_kp, gains.amplitude_ki), given(gains.frequency_kp, gains.frequency_ki)),
        None => (design(gain), design(tau)),
    }
}

pub(crate) fn period_s(configure: &Configure) -> f32 {
    configure.period_us as f32 * 1e-6
}

/// Loop delay from sampling to actuation; 0 if it is unknown.
pub(crate) fn loop_delay_s(configure: &Configure) -> f32 {
    configure.loop_delay_us as f32 * 1e-6
}

pub(crate) fn response_time_s(configure: &Configure) -> f32 {
    if configure.response_time_s > 0.0 {
        configure.response_time_s
    } else {
        design::default_response_time_s(configure.law) as f32
    }
}

pub(crate) fn closed_loop_pole(configure: &Configure) -> f32 {
    design::closed_loop_pole(response_time_s(configure), period_s(configure))
}

/// Converts the integral gains from per period to per second, as the protocol states them.
pub(crate) fn reported_gains(amplitude: PiGains, frequency: PiGains, period: f32) -> Gains {
    Gains {
        amplitude_kp: amplitude.proportional,
        amplitude_ki: amplitude.integral_per_period / period,
        frequency_kp: frequency.proportional,
        frequency_ki: frequency.integral_per_period / period,
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AmplitudeLoop {
    pub(crate) pi: Pi,
    limit_vpp: f32,
}

impl AmplitudeLoop {
    pub(crate) fn new(gains: PiGains, configure: &Configure) -> Self {
        Self { pi: Pi::new(gains, AMPLITUDE_TRACKING), limit_vpp: configure.drive_limit_vpp }
    }

    /// Returns the drive and, at the limit, [`flags::SATURATED`]. `error_um` is setpoint −
    /// amplitude.
    pub(crate) fn step(&mut self, error_um: f32) -> (f32, u8) {
        let drive_vpp = self.pi.step(error_um, 0.0, self.limit_vpp);
        (drive_vpp, if drive_vpp >= self.limit_vpp { flags::SATURATED } else { 0 })
    }
}

/// Excitation frequency relative to the start frequency, rad/s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Excitation {
    range: f32,
    slew: f32,
    offset: f32,
}

impl Excitation {
    pub(crate) fn new(configure: &Configure) -> Self {
        Self { range: configure.frequency_range_hz * TAU, slew: configure.frequency_slew_hz * TAU, offset: 0.0 }
    }

    pub(crate) fn offset_limits(&self) -> (f32, f32) {
        ((self.offset - self.slew).max(-self.range), (self.offset + self.slew).min(self.range))
    }

    /// Moves as far as range and slew limit allow. Returns [`flags::FREQUENCY_LIMITED`] at a limit.
    pub(crate) fn move_to(&mut self, offset_rad: f32) -> u8 {
        let (low, high) = self.offset_limits();
        self.offset = offset_rad.clamp(low, high);
        if self.offset <= low || self.offset >= high { flags::FREQUENCY_LIMITED } else { 0 }
    }

    pub(crate) fn range(&self) -> f32 {
        self.range
    }

    pub(crate) fn offset_rad(&self) -> f32 {
        self.offset
    }

    pub(crate) fn offset_hz(&self) -> f32 {
        self.offset / TAU
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FrequencyLoop {
    pub(crate) pi: Pi,
    pub(crate) excitation: Excitation,
}

impl FrequencyLoop {
    pub(crate) fn new(gains: PiGains, configure: &Configure) -> Self {
        Self { pi: Pi::new(gains, Tracking::CONDITIONED), excitation: Excitation::new(configure) }
    }

    /// A positive `ratio` (Wq/Wd or arg W) raises the frequency. Returns [`flags`] of the command.
    pub(crate) fn step(&mut self, ratio: f32) -> u8 {
        let (low, high) = self.excitation.offset_limits();
        let offset = self.pi.step(ratio, low, high);
        self.excitation.move_to(offset)
    }
}
