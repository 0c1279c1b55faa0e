//! Computes the gains of the laws, in f32 on a board and in f64 for studies of the loops.

use core::ops::{Add, Div, Mul, Neg, Sub};
use platebench_wire::LawId;

pub const FREQUENCY_ONLY_DRIVE_SHARE: f32 = 0.5;
/// Smallest detuning in [`inverse_slope`], half bandwidths. At resonance the slope is 0, so its
/// inverse would be infinite.
const SMALLEST_DETUNING: f32 = 0.5;

/// 5 % response time, s, if the configuration states none. With 2.0 ms the matched design leaves
/// 4.98 % after two periods of 1 ms. The margin to the 5 % band is then smaller than the ripple of
/// the fast mode; 1.9 ms leave 4.2 %. `dq-pi-euler` has the paper's response time. `frequency-only`
/// is slow, because a step of ω makes |W| oscillate at Δω with the time constant τ.
pub const fn default_response_time_s(law: LawId) -> f64 {
    match law {
        LawId::DqPiEuler => 2.0e-3,
        LawId::FrequencyOnly => 10e-3,
        LawId::Deadbeat => 3e-3,
        _ => 1.9e-3,
    }
}

pub trait Real:
    Copy
    + From<f32>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    #[must_use]
    fn exp(self) -> Self;
    #[must_use]
    fn max(self, other: Self) -> Self;
}

impl Real for f32 {
    fn exp(self) -> Self {
        libm::expf(self)
    }

    fn max(self, other: Self) -> Self {
        Self::max(self, other)
    }
}

impl Real for f64 {
    fn exp(self) -> Self {
        libm::exp(self)
    }

    fn max(self, other: Self) -> Self {
        Self::max(self, other)
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PiGains<F = f32> {
    pub proportional: F,
    /// Ki·Ts, output per error and period.
    pub integral_per_period: F,
}

impl PiGains {
    pub const NONE: Self = Self { proportional: 0.0, integral_per_period: 0.0 };
}

impl<F: Real> PiGains<F> {
    /// Gains from equation 24 for a plant `gain/(1 + τp)`: as printed for `dq-pi-euler`, matched to
    /// the zero-order hold for every other law. Times are in s.
    pub fn of_law(law: LawId, gain: F, time_constant: F, response_time: F, period: F) -> Self {
        match law {
            LawId::DqPiEuler => Self::as_printed(gain, time_constant, response_time, period),
            _ => Self::zero_order_hold_matched(gain, time_constant, response_time, period),
        }
    }

    /// Equation 24 as printed, with a forward-Euler integral: `Kp = 3τ/(K t_r)`, `Ki = Kp/τ`.
    pub fn as_printed(gain: F, time_constant: F, response_time: F, period: F) -> Self {
        let proportional = F::from(3.0) * time_constant / (gain * response_time);
        Self { proportional, integral_per_period: proportional / time_constant * period }
    }

    /// Equation 24 matched to the zero-order hold. The controller's zero cancels the plant's
    /// sampled pole `a = e^(−Ts/τ)`. The closed loop has the pole `p = e^(−3 Ts/t_r)`. The open
    /// loop is `Kp (1 − a) K / (z − 1)`, so `Kp = (1 − p) / (K (1 − a))`, `Ki·Ts = Kp (1 − a)`.
    pub fn zero_order_hold_matched(gain: F, time_constant: F, response_time: F, period: F) -> Self {
        let plant_pole = (-period / time_constant).exp();
        Self::from_poles(gain, plant_pole, closed_loop_pole(response_time, period))
    }

    /// The poles a and p of [`Self::zero_order_hold_matched`], per period.
    pub fn from_poles(gain: F, plant_pole: F, closed_loop_pole: F) -> Self {
        let one = F::from(1.0);
        let proportional = (one - closed_loop_pole) / (gain * (one - plant_pole));
        Self { proportional, integral_per_period: proportional * (one - plant_pole) }
    }
}

/// Pole per period of a loop that settles to 5 % in `response_time`: `e^(−3 Ts/t_r)`.
pub fn closed_loop_pole<F: Real>(response_time: F, period: F) -> F {
    (F::from(-3.0) * period / response_time).exp()
}

/// `−dΔω / d ln|W|` of the resonance curve, rad/s. `detuning` is in half bandwidths. The integral
/// gain of `frequency-only` per period is this value times `1 − p`; p is [`closed_loop_pole`].
pub fn inverse_slope<F: Real>(detuning: F, time_constant: F) -> F {
    let x = detuning.max(F::from(SMALLEST_DETUNING));
    (F::from(1.0) + x * x) / (x * time_constant)
}
