//! Defines linear controllers with one integral per loop, discretised from the paper's equation 24.

use nalgebra::Matrix2;
use platebench_controller::design;

/// `u = proportional · e + x`, then `x += integral_per_period · e`. The firmware's type in f64.
pub type PiGains = design::PiGains<f64>;

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Discretisation {
    /// Equation 24 as printed, with a forward-Euler integral: `u = Kp e + x`, then `x += Ki Ts e`.
    Forward,
    /// Equation 24 as printed, with a backward-Euler integral: `x += Ki Ts e`, then `u = Kp e + x`.
    Backward,
    /// Matched to the zero-order hold. The zero of the PI is the sampled pole of the plant.
    Matched,
}

impl Discretisation {
    pub const ALL: [Self; 3] = [Self::Forward, Self::Backward, Self::Matched];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward Euler, as printed",
            Self::Backward => "backward Euler, as printed",
            Self::Matched => "zero-order-hold match",
        }
    }

    /// Gains by equation 24 for the plant K/(1 + τp). `gain` is K, all times are in s.
    pub fn gains(self, gain: f64, time_constant: f64, response: f64, period: f64) -> PiGains {
        let printed = PiGains::as_printed(gain, time_constant, response, period);
        match self {
            Self::Forward => printed,
            // A backward integral equals a forward one with this larger proportional gain.
            Self::Backward => PiGains { proportional: printed.proportional + printed.integral_per_period, ..printed },
            Self::Matched => PiGains::zero_order_hold_matched(gain, time_constant, response, period),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopChannel {
    pub pi: PiGains,
    /// Change of the error per µm of Wd and per µm of Wq.
    pub error_weights: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinearController {
    pub drive: Option<LoopChannel>,
    pub frequency: Option<LoopChannel>,
    /// Feedforward of the drive, Vpp per µm of setpoint.
    pub feedforward: f64,
}

impl LinearController {
    /// Matrices of `u = direct · y + x` and `x += integral · y` for a deviation y = (Wd, Wq).
    pub(crate) fn matrices(&self) -> [Matrix2<f64>; 2] {
        let row = |channel: Option<LoopChannel>, gain: fn(&PiGains) -> f64| {
            channel.map_or([0.0; 2], |channel| channel.error_weights.map(|error| gain(&channel.pi) * error))
        };
        [|pi: &PiGains| pi.proportional, |pi: &PiGains| pi.integral_per_period].map(|gain| {
            let [a, b] = row(self.drive, gain);
            let [c, d] = row(self.frequency, gain);
            Matrix2::new(a, b, c, d)
        })
    }

    pub(crate) fn closed_channels(&self) -> [bool; 2] {
        [self.drive.is_some(), self.frequency.is_some()]
    }
}
