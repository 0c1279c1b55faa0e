//! Exact propagation between two events: drive, excitation frequency, damping and resonance constant.
//!
//! With `y = Re(W e^{jθ})`, `θ' = ω` and the voltage on the q axis, equation 1 reads `y'' + 2σy' + ω0²y = (N/m) Re(jV e^{jθ})`.
//!
//! * **modal**: states `W` and `U = W' + jωW`, so that `y' = Re(U e^{jθ})`. U, not W', is continuous when ω steps. Two poles
//!   `s± = −σ ± j√(ω0² − σ²)` around the steady state `W∞ = (N/m) jV / (ω0² − ω² + 2jσω)`.
//! * **carrier**: the same W and U; what it adds is the phase of the carrier, which [`crate::Plant`] keeps.
//! * **envelope**: `W' = λW + bV`, `λ = −σ − jΔω`, `b = K1 σ0`: what is left for ω ≈ ω0 once the pole `s−`, some 64 kHz away in
//!   this frame, is dropped (equations 11 and 18 without their linearisation).
//! * **linear**: `Wd' = −σWd + bV` and, for the ratio `r = Wq/Wd`, `r' = −σr − Δω`: equations 13 and 19, static gains
//!   `K1 σ0/σ` and `−1/σ`, both with the time constant 1/σ. The ratio is a state of its own, so that it means something while
//!   Wd is 0: it starts at 0 and moves with the detuning whether there is a vibration or not.

use crate::mode::{Drive, Mode};
use crate::tier::Tier;
use num_complex::Complex64;

const J: Complex64 = Complex64::I;

/// Components smaller than this, in µm or µm/s, are set to zero: a decaying component would otherwise spend its life in
/// subnormal numbers, which cost many times the time.
const NEGLIGIBLE: f64 = 1e-150;

/// The plate's state in the rotating frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// `W = Wd + jWq`, µm.
    pub w: Complex64,
    /// `U = W' + jωW`, µm/s; zero and unused in the envelope tier. The linear tier keeps the ratio Wq/Wd in its real part, a pure
    /// number, and `w` is `Wd (1 + j Wq/Wd)`.
    pub u: Complex64,
}

impl State {
    /// |W|, µm.
    pub fn amplitude(&self) -> f64 {
        self.w.norm()
    }

    /// False where a component is NaN or infinite.
    pub fn is_finite(&self) -> bool {
        self.w.is_finite() && self.u.is_finite()
    }

    pub(crate) fn flushed(self) -> Self {
        let flush = |z: Complex64| {
            let part = |x: f64| if x.abs() < NEGLIGIBLE { 0.0 } else { x };
            Complex64::new(part(z.re), part(z.im))
        };
        Self { w: flush(self.w), u: flush(self.u) }
    }
}

/// The plate's motion from an instant on, for as long as nothing changes.
#[derive(Debug, Clone, Copy)]
pub struct Flow {
    rest: Complex64,
    slow: Term,
    beside: Beside,
}

/// What there is beside the slow pole.
#[derive(Debug, Clone, Copy)]
enum Beside {
    /// Nothing: the envelope.
    Nothing,
    /// The fast pole's share, and ω.
    Fast(Term, f64),
    /// The linear tier's ratio: where it comes to rest, and how far it is from there. The slow term is that of Wd.
    Ratio { rest: f64, amplitude: f64 },
}

/// `amplitude · e^{pole t}` in the rotating frame.
#[derive(Debug, Clone, Copy)]
struct Term {
    amplitude: Complex64,
    pole: Complex64,
}

impl Term {
    fn after(&self, seconds: f64) -> Complex64 {
        self.amplitude * (self.pole * seconds).exp()
    }
}

impl Flow {
    /// The motion of a plate in `state` under `mode` and `drive`.
    ///
    /// `mode` must be resonant (σ < ω0), which a checked plate and scenario guarantee.
    pub fn new(tier: Tier, mode: &Mode, drive: &Drive, state: &State) -> Self {
        match tier {
            Tier::Linear => Self::linear(mode, drive, state),
            Tier::Modal | Tier::Carrier => Self::modal(mode, drive, state),
            Tier::Envelope => Self::envelope(mode, drive, state),
        }
    }

    fn envelope(mode: &Mode, drive: &Drive, state: &State) -> Self {
        let pole = Complex64::new(-mode.sigma, mode.omega0 - drive.omega);
        let rest = -mode.envelope_constant * drive.vpp / pole;
        Self { rest, slow: Term { amplitude: state.w - rest, pole }, beside: Beside::Nothing }
    }

    fn linear(mode: &Mode, drive: &Drive, state: &State) -> Self {
        let rest = mode.envelope_constant * drive.vpp / mode.sigma;
        let ratio = (mode.omega0 - drive.omega) / mode.sigma;
        Self {
            rest: Complex64::new(rest, rest * ratio),
            slow: Term { amplitude: (state.w.re - rest).into(), pole: (-mode.sigma).into() },
            beside: Beside::Ratio { rest: ratio, amplitude: state.u.re - ratio },
        }
    }

    fn modal(mode: &Mode, drive: &Drive, state: &State) -> Self {
        let Mode { sigma, omega0, .. } = *mode;
        let omega = drive.omega;
        let damped = ((omega0 - sigma) * (omega0 + sigma)).sqrt();
        let stiffness = Complex64::new((omega0 - omega) * (omega0 + omega), 2.0 * sigma * omega);
        let rest = J * (mode.force_constant * drive.vpp) / stiffness;
        // Deviation from the steady state, split over both poles: w = A + B, u = s₊A + s₋B.
        let w = state.w - rest;
        let u = state.u - J * omega * rest;
        let (plus, minus) = (Complex64::new(-sigma, damped), Complex64::new(-sigma, -damped));
        let slow = (u - minus * w) / (plus - minus);
        Self {
            rest,
            slow: Term { amplitude: slow, pole: Complex64::new(-sigma, damped - omega) },
            beside: Beside::Fast(Term { amplitude: w - slow, pole: Complex64::new(-sigma, -damped - omega) }, omega),
        }
    }

    /// The state `seconds` later.
    pub fn after(&self, seconds: f64) -> State {
        let state = match &self.beside {
            Beside::Nothing => State { w: self.rest + self.slow.after(seconds), u: Complex64::ZERO },
            Beside::Fast(term, omega) => {
                let slow = self.slow.after(seconds);
                let fast = term.after(seconds);
                let frame = J * *omega;
                // The poles of U' in the fixed frame are those of the rotating frame plus jω.
                let u = frame * self.rest + (self.slow.pole + frame) * slow + (term.pole + frame) * fast;
                State { w: self.rest + slow + fast, u }
            }
            Beside::Ratio { rest, amplitude } => {
                let left = (self.slow.pole.re * seconds).exp();
                let (in_phase, ratio) = (self.rest.re + self.slow.amplitude.re * left, rest + amplitude * left);
                State { w: Complex64::new(in_phase, in_phase * ratio), u: ratio.into() }
            }
        };
        state.flushed()
    }

    /// An upper bound, in µm, on how far W gets from where it is now within `seconds`.
    pub fn reach(&self, seconds: f64) -> f64 {
        let slow = self.slow.amplitude.norm() * (self.slow.pole.norm() * seconds).min(2.0);
        match &self.beside {
            Beside::Nothing => slow,
            Beside::Fast(term, _) => slow + 2.0 * term.amplitude.norm(),
            // Δ(r Wd) = r ΔWd + (Wd + ΔWd) Δr, with r, Wd as they are now.
            Beside::Ratio { rest, amplitude } => {
                let in_phase = (self.rest.re + self.slow.amplitude.re).abs();
                let turned = amplitude.abs() * (self.slow.pole.norm() * seconds).min(1.0);
                slow * (1.0 + (rest + amplitude).abs()) + (in_phase + slow) * turned
            }
        }
    }

    /// W as `rest + Σ amplitude e^{pole t}`, µm and 1/s, in every tier.
    pub(crate) fn parts(&self) -> (Complex64, [(Complex64, Complex64); 2]) {
        let slow = (self.slow.amplitude, self.slow.pole);
        let other = match &self.beside {
            Beside::Nothing => (Complex64::ZERO, Complex64::ZERO),
            Beside::Fast(term, _) => (term.amplitude, term.pole),
            // (Wd∞ + a e)(1 + j (r∞ + c e)) with e = e^{−σt}.
            Beside::Ratio { rest, amplitude } => {
                let first = slow.0 * (1.0 + J * rest) + J * *amplitude * self.rest.re;
                return (self.rest, [(first, slow.1), (slow.0 * J * *amplitude, 2.0 * slow.1)]);
            }
        };
        (self.rest, [slow, other])
    }

    /// The steady state W∞, µm.
    pub fn rest(&self) -> Complex64 {
        self.rest
    }
}
