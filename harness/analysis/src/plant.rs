//! The plate around an operating point, as a sum of complex poles.
//!
//! Both tiers are linear in W; only the product of W and ω is not. Around a steady state W0 at drive V0 and excitation ω0 a small δω acts on the envelope as
//! `−jW0 δω`, so that
//!
//! * **envelope**: `δW' = λ δW + b δV − jW0 δω`, one pole `λ = −σ − jΔω` (equations 13 and 19 are its two parts at resonance);
//! * **modal**: the poles `s± − jω`, each with its share of `jN/m δV` on U and of `−j(W0, U0) δω` on both states.
//!
//! Between two actuations each pole has the closed form `x(h) = e^{sh} x + φ(h) u`, `φ = (e^{sh} − 1)/s`: sampling is exact, for any part of a period.

use platebench_plate::{Complex64, Drive, Flow, Mode, State, Tier};

/// One pole of the plate in the rotating frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pole {
    /// The pole s, 1/s.
    pub value: Complex64,
    /// What a drive does to it, µm/s per Vpp.
    pub by_drive: Complex64,
    /// What an excitation frequency does to it, µm/s per rad/s.
    pub by_frequency: Complex64,
}

impl Pole {
    /// `e^{sh}` after `seconds`.
    pub(crate) fn growth(&self, seconds: f64) -> Complex64 {
        (self.value * seconds).exp()
    }

    /// What a unit of drive and of frequency, on for `seconds`, have made of it.
    pub(crate) fn pushes(&self, seconds: f64) -> [Complex64; 2] {
        let phi = (self.growth(seconds) - 1.0) / self.value;
        [phi * self.by_drive, phi * self.by_frequency]
    }
}

/// The plate around a steady state. W's deviation is the sum of its poles' states.
#[derive(Debug, Clone, PartialEq)]
pub struct Plant {
    poles: Vec<Pole>,
    at: Complex64,
}

impl Plant {
    /// The plate with `mode` around the steady state that `drive` leads to. The mode must be resonant.
    pub fn around(tier: Tier, mode: &Mode, drive: &Drive) -> Self {
        let at = steady(tier, mode, drive);
        let j = Complex64::I;
        let poles = match tier {
            // Without the coupling the detuning turns nothing: both responses decay with σ.
            Tier::Linear => vec![Pole {
                value: (-mode.sigma).into(),
                by_drive: mode.envelope_constant.into(),
                by_frequency: -j * at.re,
            }],
            Tier::Envelope => vec![Pole {
                value: Complex64::new(-mode.sigma, mode.omega0 - drive.omega),
                by_drive: mode.envelope_constant.into(),
                by_frequency: -j * at,
            }],
            Tier::Modal | Tier::Carrier => {
                let damped = ((mode.omega0 - mode.sigma) * (mode.omega0 + mode.sigma)).sqrt();
                let [plus, minus] = [damped, -damped].map(|damped| Complex64::new(-mode.sigma, damped));
                // A push (w, u) on (W, U) is shared as A = (u − s₋w)/(s₊ − s₋), B = w − A.
                let shared = |w: Complex64, u: Complex64| {
                    let plus_share = (u - minus * w) / (plus - minus);
                    [plus_share, w - plus_share]
                };
                let by_drive = shared(Complex64::ZERO, j * mode.force_constant);
                let by_frequency = shared(-j * at, -j * (j * drive.omega * at));
                let turning = j * drive.omega;
                [(plus, 0), (minus, 1)]
                    .map(|(s, n)| Pole { value: s - turning, by_drive: by_drive[n], by_frequency: by_frequency[n] })
                    .to_vec()
            }
        };
        Self { poles, at }
    }

    /// The poles, the slow one first.
    pub fn poles(&self) -> &[Pole] {
        &self.poles
    }

    /// W0, µm.
    pub fn at(&self) -> Complex64 {
        self.at
    }
}

/// W∞ of a plate under a constant drive, µm.
pub fn steady(tier: Tier, mode: &Mode, drive: &Drive) -> Complex64 {
    Flow::new(tier, mode, drive, &State::default()).rest()
}
