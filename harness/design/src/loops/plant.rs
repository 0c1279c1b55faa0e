//! Linearises the plate around an operating point as a sum of complex poles.
//!
//! Both tiers are linear in W; only the product of W and ω is not. Around a steady state W0 at
//! drive V0 and excitation ω a small δω acts on the envelope as `−jW0 δω`:
//!
//! * **envelope**: `δW' = λ δW + b δV − jW0 δω`, one pole `λ = −σ − jΔω` (at resonance equations 13
//!   and 19);
//! * **modal**: the poles `s± − jω`, each with its share of `jN/m δV` on U and of `−j(W0, U0) δω`
//!   on both states.
//!
//! Between two actuations each pole has the closed form `x(h) = e^{sh} x + φ(h) u`,
//! `φ = (e^{sh} − 1)/s`. Therefore sampling is exact for any part of a period.

use platebench_plate::{Complex64, Drive, Flow, Mode, State, Tier};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pole {
    /// The pole s, 1/s.
    pub value: Complex64,
    /// Input gain of the drive, µm/s per Vpp.
    pub drive_gain: Complex64,
    /// Input gain of the excitation frequency, µm/s per rad/s.
    pub frequency_gain: Complex64,
}

impl Pole {
    pub(crate) fn transition(&self, seconds: f64) -> Complex64 {
        (self.value * seconds).exp()
    }

    /// Changes of the state after `seconds`, per Vpp of drive and per rad/s of excitation.
    pub(crate) fn input_effects(&self, seconds: f64) -> [Complex64; 2] {
        let phi = (self.transition(seconds) - 1.0) / self.value;
        [phi * self.drive_gain, phi * self.frequency_gain]
    }
}

/// The deviation of W from the steady state is the sum of the poles' states.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearPlant {
    poles: Vec<Pole>,
    operating_point: Complex64,
}

impl LinearPlant {
    /// `drive` defines the steady state. The mode must be underdamped.
    pub fn linearised_at(tier: Tier, mode: &Mode, drive: &Drive) -> Self {
        let at = steady_state(tier, mode, drive);
        let j = Complex64::I;
        let poles = match tier {
            // In this tier Wd and Wq are decoupled: detuning has no effect, both decay with σ.
            Tier::Linear => vec![Pole {
                value: (-mode.sigma).into(),
                drive_gain: mode.envelope_constant.into(),
                frequency_gain: -j * at.re,
            }],
            Tier::Envelope => vec![Pole {
                value: Complex64::new(-mode.sigma, mode.omega0 - drive.omega),
                drive_gain: mode.envelope_constant.into(),
                frequency_gain: -j * at,
            }],
            Tier::Modal | Tier::Carrier => {
                let damped = ((mode.omega0 - mode.sigma) * (mode.omega0 + mode.sigma)).sqrt();
                let [plus, minus] = [damped, -damped].map(|damped| Complex64::new(-mode.sigma, damped));
                // An input (w, u) on (W, U) splits into A = (u − s₋w)/(s₊ − s₋), B = w − A.
                let shared = |w: Complex64, u: Complex64| {
                    let plus_share = (u - minus * w) / (plus - minus);
                    [plus_share, w - plus_share]
                };
                let by_drive = shared(Complex64::ZERO, j * mode.force_constant);
                let by_frequency = shared(-j * at, -j * (j * drive.omega * at));
                let turning = j * drive.omega;
                [(plus, 0), (minus, 1)]
                    .map(|(s, n)| Pole { value: s - turning, drive_gain: by_drive[n], frequency_gain: by_frequency[n] })
                    .to_vec()
            }
        };
        Self { poles, operating_point: at }
    }

    /// The poles, the slow pole first.
    pub fn poles(&self) -> &[Pole] {
        &self.poles
    }

    /// The steady state W0, µm.
    pub fn at(&self) -> Complex64 {
        self.operating_point
    }
}

pub fn steady_state(tier: Tier, mode: &Mode, drive: &Drive) -> Complex64 {
    Flow::new(tier, mode, drive, &State::default()).steady_state()
}
