//! Linear controllers: one integral per loop, and how a continuous design becomes one.

use nalgebra::Matrix2;

/// How the integral is made of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Integral {
    /// `u = Kp e + x`, then `x += Ki Ts e`.
    Forward,
    /// `x += Ki Ts e`, then `u = Kp e + x`.
    Backward,
}

/// A proportional-integral controller as it runs: `u = proportional · e + x`, then `x += integral_per_period · e`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pi {
    /// Output per error.
    pub proportional: f64,
    /// Output per error and period.
    pub integral_per_period: f64,
}

impl Pi {
    /// Equation 24 as printed, `Kp = 3τ/(K t_r)`, `Ki = Kp/τ`, with an integral of either kind. `gain` is the static gain K of the plant, times in s.
    ///
    /// A backward integral is a forward one whose proportional part has the present period's share in it.
    pub fn as_printed(integral: Integral, gain: f64, time_constant: f64, response_time: f64, period: f64) -> Self {
        let proportional = 3.0 * time_constant / (gain * response_time);
        let integral_per_period = proportional / time_constant * period;
        match integral {
            Integral::Forward => Self { proportional, integral_per_period },
            Integral::Backward => Self { proportional: proportional + integral_per_period, integral_per_period },
        }
    }

    /// Equation 24 matched to the zero-order hold: zero on the plant's pole `e^(−Ts/τ)`, closed-loop pole at `e^(−3 Ts/t_r)`.
    pub fn matched(gain: f64, time_constant: f64, response_time: f64, period: f64) -> Self {
        let plant_pole = (-period / time_constant).exp();
        let closed_loop_pole = (-3.0 * period / response_time).exp();
        let integral_per_period = (1.0 - closed_loop_pole) / gain;
        Self { proportional: integral_per_period / (1.0 - plant_pole), integral_per_period }
    }

    /// An integral alone that acts at once: `x += gain · e`, `u = x`.
    pub fn integral_at_once(gain: f64) -> Self {
        Self { proportional: gain, integral_per_period: gain }
    }

    /// Both gains times `factor`.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        let Self { proportional, integral_per_period } = self;
        Self { proportional: proportional * factor, integral_per_period: integral_per_period * factor }
    }
}

/// One loop: what it looks at and what it makes of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// Its controller, output in Vpp or rad/s.
    pub pi: Pi,
    /// The error per µm of deviation of Wd and of Wq.
    pub error: [f64; 2],
}

/// Two loops on one plate: drive and excitation frequency.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Controller {
    /// The loop that moves the drive, Vpp.
    pub drive: Option<Channel>,
    /// The loop that moves the excitation, rad/s.
    pub frequency: Option<Channel>,
    /// Drive per µm of setpoint that no error is needed for, Vpp.
    pub feedforward: f64,
}

impl Controller {
    /// What `u = direct · y + x` and `x += integral · y` take from a deviation y = (Wd, Wq).
    pub(crate) fn matrices(&self) -> [Matrix2<f64>; 2] {
        let row = |channel: Option<Channel>, gain: fn(&Pi) -> f64| {
            channel.map_or([0.0; 2], |channel| channel.error.map(|error| gain(&channel.pi) * error))
        };
        [|pi: &Pi| pi.proportional, |pi: &Pi| pi.integral_per_period].map(|gain| {
            let [a, b] = row(self.drive, gain);
            let [c, d] = row(self.frequency, gain);
            Matrix2::new(a, b, c, d)
        })
    }

    /// Which of drive and frequency is moved by a loop.
    pub(crate) fn closes(&self) -> [bool; 2] {
        [self.drive.is_some(), self.frequency.is_some()]
    }
}
