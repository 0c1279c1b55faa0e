//! The two loops that most laws are made of: amplitude by the drive, frequency by its distance from the resonance.

use crate::pi::{Pi, PiGains, Tracking};
use core::f32::consts::TAU;
use platebench_wire::{Configure, Gains, LawId, flags};

/// The paper's demand on the 5 % response time.
const PRINTED_RESPONSE_S: f32 = 2.0e-3;
/// At 2.0 ms the matched design leaves 4.98 % after two periods of 1 ms, less of a margin to the 5 % band than the plate's fast mode ripples; 1.9 ms leave
/// 4.2 %.
pub(crate) const MATCHED_RESPONSE_S: f32 = 1.9e-3;

/// At the amplifier's limit full tracking costs 16 % over the time floor at 400 Vpp and none at all overshoots by 14 % at 340 Vpp; with 0.6 the response
/// settles within 10 % of the floor from 300 to 416 Vpp and overshoots by less than 4 %. At 0 V the plate falls by its own damping and nothing brakes it:
/// there full tracking is best.
pub(crate) const AMPLITUDE_TRACKING: Tracking = Tracking { low: 1.0, high: 0.6 };

/// The gains that `configure` brings, or equation 24's: as printed for `dq-pi-euler`, matched to the zero-order hold for every other law. Amplitude first,
/// plant K1/(1 + τp) (equation 13), then frequency, plant −τ/(1 + τp) (equation 19).
pub(crate) fn gains(configure: &Configure) -> (PiGains, PiGains) {
    let period = period_s(configure);
    let (gain, tau) = (configure.gain_um_per_vpp, configure.time_constant_s);
    let design = |gain: f32| match configure.law {
        LawId::DqPiEuler => PiGains::as_printed(gain, tau, response_s(configure, PRINTED_RESPONSE_S), period),
        _ => PiGains::zero_order_hold_matched(gain, tau, response_s(configure, MATCHED_RESPONSE_S), period),
    };
    let given = |proportional, integral: f32| PiGains { proportional, integral_per_period: integral * period };
    match configure.gains {
        Some(gains) => (given(gains.amplitude_kp, gains.amplitude_ki), given(gains.frequency_kp, gains.frequency_ki)),
        None => (design(gain), design(tau)),
    }
}

/// The control period in s.
pub(crate) fn period_s(configure: &Configure) -> f32 {
    configure.period_us as f32 * 1e-6
}

/// The loop delay that the law is told of, in s; 0 where it is told nothing.
pub(crate) fn told_delay_s(configure: &Configure) -> f32 {
    configure.loop_delay_us as f32 * 1e-6
}

/// The demanded 5 % response time in s, or the law's `own`.
pub(crate) fn response_s(configure: &Configure, own: f32) -> f32 {
    if configure.response_time_s > 0.0 { configure.response_time_s } else { own }
}

/// What the bench is told of the gains in force.
pub(crate) fn told(amplitude: PiGains, frequency: PiGains, period: f32) -> Gains {
    Gains {
        amplitude_kp: amplitude.proportional,
        amplitude_ki: amplitude.integral_per_period / period,
        frequency_kp: frequency.proportional,
        frequency_ki: frequency.integral_per_period / period,
    }
}

/// The drive from an amplitude error, within what the amplifier gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AmplitudeLoop {
    pub(crate) pi: Pi,
    limit_vpp: f32,
}

impl AmplitudeLoop {
    pub(crate) fn new(gains: PiGains, configure: &Configure) -> Self {
        Self { pi: Pi::new(gains, AMPLITUDE_TRACKING), limit_vpp: configure.drive_limit_vpp }
    }

    /// Drive in Vpp, and [`flags::SATURATED`] at the limit. `error_um` is what is missing of the setpoint.
    pub(crate) fn step(&mut self, error_um: f32) -> (f32, u8) {
        let drive_vpp = self.pi.step(error_um, 0.0, self.limit_vpp);
        (drive_vpp, if drive_vpp >= self.limit_vpp { flags::SATURATED } else { 0 })
    }
}

/// The excitation in rad/s above its start: where it is, how far and how fast it may be moved.
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

    /// Lowest and highest offset that the next period may have, rad/s.
    pub(crate) fn reach(&self) -> (f32, f32) {
        ((self.offset - self.slew).max(-self.range), (self.offset + self.slew).min(self.range))
    }

    /// Moves to `offset_rad`, as far as range and slew allow; [`flags::FREQUENCY_LIMITED`] where they do not.
    pub(crate) fn move_to(&mut self, offset_rad: f32) -> u8 {
        let (low, high) = self.reach();
        self.offset = offset_rad.clamp(low, high);
        if self.offset <= low || self.offset >= high { flags::FREQUENCY_LIMITED } else { 0 }
    }

    /// Furthest offset, rad/s.
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

/// The excitation from a measure of how far below the resonance it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FrequencyLoop {
    pub(crate) pi: Pi,
    pub(crate) excitation: Excitation,
}

impl FrequencyLoop {
    pub(crate) fn new(gains: PiGains, configure: &Configure) -> Self {
        Self { pi: Pi::new(gains, Tracking::CONDITIONED), excitation: Excitation::new(configure) }
    }

    /// One period; `ratio` is positive where the excitation is to rise. The flags that it raises.
    pub(crate) fn step(&mut self, ratio: f32) -> u8 {
        let (low, high) = self.excitation.reach();
        let offset = self.pi.step(ratio, low, high);
        self.excitation.move_to(offset)
    }
}
