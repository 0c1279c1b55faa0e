//! Defines linear controllers with one integral per loop, and their discretisation.

use nalgebra::Matrix2;

/// Discretisation of the integral.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IntegralMethod {
    /// `u = Kp e + x`, then `x += Ki Ts e`.
    Forward,
    /// `x += Ki Ts e`, then `u = Kp e + x`.
    Backward,
}

/// A proportional-integral controller as it runs: `u = proportional · e + x`, then `x +=
/// integral_per_period · e`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PiGains {
    /// Output per error.
    pub proportional: f64,
    /// Output per error and period.
    pub integral_per_period: f64,
}

impl PiGains {
    /// Equation 24 as printed, `Kp = 3τ/(K t_r)`, `Ki = Kp/τ`. `gain` is the static gain K of the
    /// plant, times in s.
    ///
    /// A backward integral equals a forward one with `proportional + integral_per_period` as
    /// proportional gain.
    pub fn as_printed(
        integral: IntegralMethod,
        gain: f64,
        time_constant: f64,
        response_time: f64,
        period: f64,
    ) -> Self {
        let proportional = 3.0 * time_constant / (gain * response_time);
        let integral_per_period = proportional / time_constant * period;
        match integral {
            IntegralMethod::Forward => Self { proportional, integral_per_period },
            IntegralMethod::Backward => Self { proportional: proportional + integral_per_period, integral_per_period },
        }
    }

    /// Equation 24 matched to the zero-order hold: zero on the plant's pole `e^(−Ts/τ)`,
    /// closed-loop pole at `e^(−3 Ts/t_r)`.
    pub fn matched(gain: f64, time_constant: f64, response_time: f64, period: f64) -> Self {
        let plant_pole = (-period / time_constant).exp();
        let closed_loop_pole = (-3.0 * period / response_time).exp();
        let integral_per_period = (1.0 - closed_loop_pole) / gain;
        Self { proportional: integral_per_period / (1.0 - plant_pole), integral_per_period }
    }

    /// A pure integral that acts at once: `x += gain · e`, `u = x`.
    pub fn integral_only(gain: f64) -> Self {
        Self { proportional: gain, integral_per_period: gain }
    }

    /// Both gains times `factor`.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        let Self { proportional, integral_per_period } = self;
        Self { proportional: proportional * factor, integral_per_period: integral_per_period * factor }
    }
}

/// One loop: its error and its controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopChannel {
    /// Its controller, output in Vpp or rad/s.
    pub pi: PiGains,
    /// The error per µm of deviation of Wd and of Wq.
    pub error_weights: [f64; 2],
}

/// Two loops on one plate: drive and excitation frequency.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinearController {
    /// Loop of the drive, Vpp.
    pub drive: Option<LoopChannel>,
    /// Loop of the excitation frequency, rad/s.
    pub frequency: Option<LoopChannel>,
    /// Feedforward of the drive, Vpp per µm of setpoint.
    pub feedforward: f64,
}

impl LinearController {
    /// The matrices of `u = direct · y + x` and `x += integral · y` for a deviation y = (Wd, Wq).
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

    /// Whether drive and frequency have a loop.
    pub(crate) fn closed_channels(&self) -> [bool; 2] {
        [self.drive.is_some(), self.frequency.is_some()]
    }
}
