//! Propagates the plate exactly while drive, frequency, damping and resonance are constant.
//!
//! With `y = Re(W e^{jθ})`, `θ' = ω` and the voltage on the q axis, equation 1 is
//! `y'' + 2σy' + ω0²y = (N/m) Re(jV e^{jθ})`.
//!
//! * **modal**: the states are `W` and `U = W' + jωW`, so that `y' = Re(U e^{jθ})`. If ω steps, U
//!   is continuous and W' is not. The two poles are `s± = −σ ± j√(ω0² − σ²)`, the steady state is
//!   `W∞ = (N/m) jV / (ω0² − ω² + 2jσω)`.
//! * **carrier**: the same W and U; [`crate::Plant`] adds the phase of the carrier.
//! * **envelope**: `W' = λW + bV`, `λ = −σ − jΔω`, `b = K1 σ0` (equations 11 and 18 without their
//!   linearisation). This approximation for ω ≈ ω0 omits the pole `s−`, which is about 64 kHz away
//!   in this frame.
//! * **linear**: `Wd' = −σWd + bV` and, for the ratio `r = Wq/Wd`, `r' = −σr − Δω`. These are
//!   equations 13 and 19 with the static gains `K1 σ0/σ` and `−1/σ` and the time constant 1/σ. The
//!   ratio is a separate state that starts at 0, so that it is defined while Wd is 0.

use crate::mode::{Drive, Mode};
use crate::tier::Tier;
use num_complex::Complex64;

const J: Complex64 = Complex64::I;

/// Smaller components, µm or µm/s, become 0, because subnormal arithmetic is many times slower.
const NEGLIGIBLE: f64 = 1e-150;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// `W = Wd + jWq`, µm.
    pub w: Complex64,
    /// `U = W' + jωW`, µm/s; 0 in the envelope tier. In the linear tier the real part is the ratio
    /// Wq/Wd, and `w` is `Wd (1 + j Wq/Wd)`.
    pub u: Complex64,
}

impl State {
    pub fn amplitude(&self) -> f64 {
        self.w.norm()
    }

    pub fn is_finite(&self) -> bool {
        self.w.is_finite() && self.u.is_finite()
    }

    pub(crate) fn flush_negligible(self) -> Self {
        let flush = |z: Complex64| {
            let part = |x: f64| if x.abs() < NEGLIGIBLE { 0.0 } else { x };
            Complex64::new(part(z.re), part(z.im))
        };
        Self { w: flush(self.w), u: flush(self.u) }
    }
}

/// Bound on the change of W: in t seconds at most `speed · t + min(ripple, ripple_speed · t)`, µm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExcursionBound {
    pub(crate) speed: f64,
    pub(crate) ripple: f64,
    pub(crate) ripple_speed: f64,
}

impl ExcursionBound {
    pub(crate) fn plus(&self, other: &Self) -> Self {
        Self {
            speed: self.speed + other.speed,
            ripple: self.ripple + other.ripple,
            ripple_speed: self.ripple_speed + other.ripple_speed,
        }
    }

    /// Time in s during which W changes by less than `distance` µm. It may be negative, infinite or
    /// NaN.
    pub(crate) fn seconds_within(&self, distance: f64) -> f64 {
        ((distance - self.ripple) / self.speed).max(distance / (self.speed + self.ripple_speed))
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Flow {
    steady_state: Complex64,
    slow_pole: ExponentialTerm,
    second_term: SecondTerm,
}

#[derive(Debug, Clone, Copy)]
enum SecondTerm {
    Envelope,
    /// Fast pole, and the excitation frequency ω. Modal and carrier tier.
    FastPole(ExponentialTerm, f64),
    /// Ratio Wq/Wd of the linear tier. `slow_pole` is then the pole of Wd.
    Ratio {
        rest: f64,
        amplitude: f64,
    },
}

/// `amplitude · e^{pole t}` in the rotating frame.
#[derive(Debug, Clone, Copy)]
struct ExponentialTerm {
    amplitude: Complex64,
    pole: Complex64,
}

impl ExponentialTerm {
    fn after(&self, seconds: f64) -> Complex64 {
        self.amplitude * (self.pole * seconds).exp()
    }
}

impl Flow {
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
        Self {
            steady_state: rest,
            slow_pole: ExponentialTerm { amplitude: state.w - rest, pole },
            second_term: SecondTerm::Envelope,
        }
    }

    fn linear(mode: &Mode, drive: &Drive, state: &State) -> Self {
        let rest = mode.envelope_constant * drive.vpp / mode.sigma;
        let ratio = (mode.omega0 - drive.omega) / mode.sigma;
        Self {
            steady_state: Complex64::new(rest, rest * ratio),
            slow_pole: ExponentialTerm { amplitude: (state.w.re - rest).into(), pole: (-mode.sigma).into() },
            second_term: SecondTerm::Ratio { rest: ratio, amplitude: state.u.re - ratio },
        }
    }

    fn modal(mode: &Mode, drive: &Drive, state: &State) -> Self {
        let Mode { sigma, omega0, .. } = *mode;
        let omega = drive.omega;
        let damped = ((omega0 - sigma) * (omega0 + sigma)).sqrt();
        let stiffness = Complex64::new((omega0 - omega) * (omega0 + omega), 2.0 * sigma * omega);
        let rest = J * (mode.force_constant * drive.vpp) / stiffness;
        // Deviation from the steady state as the sum over both poles: w = A + B, u = s₊A + s₋B.
        let w = state.w - rest;
        let u = state.u - J * omega * rest;
        let (plus, minus) = (Complex64::new(-sigma, damped), Complex64::new(-sigma, -damped));
        let slow = (u - minus * w) / (plus - minus);
        Self {
            steady_state: rest,
            slow_pole: ExponentialTerm { amplitude: slow, pole: Complex64::new(-sigma, damped - omega) },
            second_term: SecondTerm::FastPole(
                ExponentialTerm { amplitude: w - slow, pole: Complex64::new(-sigma, -damped - omega) },
                omega,
            ),
        }
    }

    pub fn after(&self, seconds: f64) -> State {
        let state = match &self.second_term {
            SecondTerm::Envelope => State { w: self.steady_state + self.slow_pole.after(seconds), u: Complex64::ZERO },
            SecondTerm::FastPole(term, omega) => {
                let slow = self.slow_pole.after(seconds);
                let fast = term.after(seconds);
                let frame = J * *omega;
                // U is in the fixed frame, so its poles are those of the rotating frame plus jω.
                let u = frame * self.steady_state + (self.slow_pole.pole + frame) * slow + (term.pole + frame) * fast;
                State { w: self.steady_state + slow + fast, u }
            }
            SecondTerm::Ratio { rest, amplitude } => {
                let left = (self.slow_pole.pole.re * seconds).exp();
                let (in_phase, ratio) =
                    (self.steady_state.re + self.slow_pole.amplitude.re * left, rest + amplitude * left);
                State { w: Complex64::new(in_phase, in_phase * ratio), u: ratio.into() }
            }
        };
        state.flush_negligible()
    }

    /// The bound is valid from any instant of the flow on.
    pub(crate) fn excursion_bound(&self) -> ExcursionBound {
        // One square root instead of two calls of `hypot`, which took 10 % of a trial's time.
        let speed = |term: &ExponentialTerm| (term.amplitude.norm_sqr() * term.pole.norm_sqr()).sqrt();
        let slow = speed(&self.slow_pole);
        match &self.second_term {
            SecondTerm::Envelope => ExcursionBound { speed: slow, ripple: 0.0, ripple_speed: 0.0 },
            SecondTerm::FastPole(term, _) => ExcursionBound {
                speed: slow,
                ripple: 2.0 * term.amplitude.norm_sqr().sqrt(),
                ripple_speed: speed(term),
            },
            // Change of Wq = r Wd: Δ(r Wd) = r ΔWd + Wd Δr, with the largest |r| and |Wd|.
            SecondTerm::Ratio { rest, amplitude } => {
                let in_phase = self.steady_state.re.abs() + self.slow_pole.amplitude.re.abs();
                let turned = amplitude.abs() * self.slow_pole.pole.norm();
                let speed = slow * (1.0 + rest.abs() + amplitude.abs()) + in_phase * turned;
                ExcursionBound { speed, ripple: 0.0, ripple_speed: 0.0 }
            }
        }
    }

    /// Constant part of W and pairs (amplitude in µm, pole in 1/s), so that
    /// `W = rest + Σ amplitude e^{pole t}` in every tier.
    pub(crate) fn terms(&self) -> (Complex64, [(Complex64, Complex64); 2]) {
        let slow = (self.slow_pole.amplitude, self.slow_pole.pole);
        let other = match &self.second_term {
            SecondTerm::Envelope => (Complex64::ZERO, Complex64::ZERO),
            SecondTerm::FastPole(term, _) => (term.amplitude, term.pole),
            // W = (Wd∞ + a e)(1 + j (r∞ + c e)) with e = e^{−σt}.
            SecondTerm::Ratio { rest, amplitude } => {
                let first = slow.0 * (1.0 + J * rest) + J * *amplitude * self.steady_state.re;
                return (self.steady_state, [(first, slow.1), (slow.0 * J * *amplitude, 2.0 * slow.1)]);
            }
        };
        (self.steady_state, [slow, other])
    }

    pub fn steady_state(&self) -> Complex64 {
        self.steady_state
    }
}
