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
use num_complex::Complex64;

const J: Complex64 = Complex64::I;

/// Smaller components, µm or µm/s, become 0, because subnormal arithmetic is many times slower.
const NEGLIGIBLE: f64 = 1e-150;
/// Smallest relative distance between the poles of amplifier and plate. Below it the response is a
/// difference of nearly equal terms, so the amplifier's pole is moved.
const MIN_POLE_DISTANCE: f64 = 1e-8;

/// Model of the plate, the key `model` of a scenario. `docs/mathematics.md` states the terms that
/// each model omits, and its error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Model {
    /// Equations 13 and 19: V gives Wd and Δω gives Wq/Wd, by two decoupled first-order systems.
    Linear,
    /// First order in the complex W, with the slow pole only.
    Envelope,
    /// Second order, exact for one mode.
    #[default]
    Modal,
    /// Modal plate with carrier, converter and demodulator. W and U equal the modal ones bit for
    /// bit.
    Carrier,
}

impl Model {
    pub const ALL: [Self; 4] = [Self::Linear, Self::Envelope, Self::Modal, Self::Carrier];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Envelope => "envelope",
            Self::Modal => "modal",
            Self::Carrier => "carrier",
        }
    }

    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    pub const fn has_both_poles(self) -> bool {
        matches!(self, Self::Modal | Self::Carrier)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// `W = Wd + jWq`, µm.
    pub w: Complex64,
    /// `U = W' + jωW`, µm/s; 0 in the envelope model. In the linear model the real part is the ratio
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

    /// Largest change of W in `seconds`, µm.
    pub(crate) fn reach(&self, seconds: f64) -> f64 {
        self.speed * seconds + self.ripple.min(self.ripple_speed * seconds)
    }

    /// Time in s during which W changes by less than `distance` µm. It may be negative, infinite or
    /// NaN.
    pub(crate) fn seconds_within(&self, distance: f64) -> f64 {
        ((distance - self.ripple) / self.speed).max(distance / (self.speed + self.ripple_speed))
    }
}

/// Amplitude in µm and pole in 1/s of `amplitude e^{pole t}`.
pub(crate) type Term = (Complex64, Complex64);

/// Motion while the modes are constant, `W = rest + Σ amplitude e^{pole t}`, with N terms.
pub(crate) trait ExponentialSum<const N: usize> {
    fn after(&self, seconds: f64) -> State;

    /// The bound is valid from any instant on.
    fn excursion_bound(&self) -> ExcursionBound;

    /// `rest` and the terms. The response to a ramp of the drive is not part of them.
    fn terms(&self) -> (Complex64, [Term; N]);
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
    /// Modal and carrier model.
    FastPole {
        term: ExponentialTerm,
        fixed: FixedFrame,
    },
    /// Ratio Wq/Wd of the linear model. `slow_pole` is then the pole of Wd.
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

/// Constants of U, which is in the fixed frame.
#[derive(Debug, Clone, Copy)]
struct FixedFrame {
    /// U of the steady state, `jωW∞`.
    rest: Complex64,
    /// The poles of `slow_pole` and `term` plus jω.
    poles: [Complex64; 2],
    /// `s₋ = −σ − j√(ω0² − σ²)`, and `s₊ − s₋`.
    minus: Complex64,
    separation: Complex64,
}

impl FixedFrame {
    /// Amplitudes of slow and fast pole of a flow from `state`. The deviation from the steady state
    /// `rest` is the sum over both poles: w = A + B, u = s₊A + s₋B.
    #[inline]
    fn amplitudes(&self, state: &State, rest: Complex64) -> [Complex64; 2] {
        let w = state.w - rest;
        let u = state.u - self.rest;
        let slow = (u - self.minus * w) / self.separation;
        [slow, w - slow]
    }
}

/// `e^{pole t}` of the slow pole and of the second term.
pub(crate) type Decays = [Complex64; 2];

/// `e^{pole t}` of the last step for the slow and the fast pole. Most steps of a trial have the same
/// poles and the same length.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LastExponentials([LastExponential; 2]);

#[derive(Debug, Clone, Copy)]
struct LastExponential {
    pole: Complex64,
    seconds: f64,
    value: Complex64,
}

impl Default for LastExponential {
    fn default() -> Self {
        Self { pole: Complex64::ZERO, seconds: 0.0, value: Complex64::ONE }
    }
}

impl LastExponential {
    #[inline]
    fn of(&mut self, pole: Complex64, seconds: f64) -> Complex64 {
        if self.pole != pole || self.seconds != seconds {
            *self = Self { pole, seconds, value: (pole * seconds).exp() };
        }
        self.value
    }
}

impl Flow {
    /// `mode` must be resonant (σ < ω0), which a checked plate and scenario guarantee.
    pub fn new(model: Model, mode: &Mode, drive: &Drive, state: &State) -> Self {
        match model {
            Model::Linear => Self::linear(mode, drive, state),
            Model::Modal | Model::Carrier => Self::modal(mode, drive, state),
            Model::Envelope => Self::envelope(mode, drive, state),
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
        let frame = J * omega;
        let poles = [damped, -damped].map(|damped| Complex64::new(-sigma, damped - omega));
        let (plus, minus) = (Complex64::new(-sigma, damped), Complex64::new(-sigma, -damped));
        let poles_in_frame = poles.map(|pole| pole + frame);
        let fixed = FixedFrame { rest: frame * rest, poles: poles_in_frame, minus, separation: plus - minus };
        let amplitudes = fixed.amplitudes(state, rest);
        let [slow_pole, term] = [0, 1].map(|n: usize| ExponentialTerm { amplitude: amplitudes[n], pole: poles[n] });
        Self { steady_state: rest, slow_pole, second_term: SecondTerm::FastPole { term, fixed } }
    }

    /// The same flow from another state, as [`Self::new`] gives it, bit for bit.
    #[inline]
    pub(crate) fn start_from(&mut self, state: &State) {
        let rest = self.steady_state;
        match &mut self.second_term {
            SecondTerm::Envelope => self.slow_pole.amplitude = state.w - rest,
            SecondTerm::FastPole { term, fixed } => {
                [self.slow_pole.amplitude, term.amplitude] = fixed.amplitudes(state, rest);
            }
            SecondTerm::Ratio { rest: ratio, amplitude } => {
                self.slow_pole.amplitude = (state.w.re - rest.re).into();
                *amplitude = state.u.re - *ratio;
            }
        }
    }

    pub fn after(&self, seconds: f64) -> State {
        let exponential = |pole: Complex64| (pole * seconds).exp();
        self.state_with(self.decays(seconds, exponential, exponential))
    }

    /// Decays of [`Self::after`], bit for bit.
    #[inline]
    pub(crate) fn decays_with(&self, last: &mut LastExponentials, seconds: f64) -> Decays {
        let [slow, fast] = &mut last.0;
        self.decays(seconds, |pole| slow.of(pole, seconds), |pole| fast.of(pole, seconds))
    }

    /// `slow` and `fast` return `e^{pole t}` at `seconds` for a slow and a fast pole.
    #[inline]
    fn decays(
        &self,
        seconds: f64,
        slow: impl FnOnce(Complex64) -> Complex64,
        fast: impl FnOnce(Complex64) -> Complex64,
    ) -> Decays {
        let pole = self.slow_pole.pole;
        match &self.second_term {
            SecondTerm::Envelope => [slow(pole), Complex64::ZERO],
            SecondTerm::FastPole { term, .. } => [slow(pole), fast(term.pole)],
            SecondTerm::Ratio { .. } => [(pole.re * seconds).exp().into(), Complex64::ZERO],
        }
    }

    #[inline]
    pub(crate) fn state_with(&self, [slow, second]: Decays) -> State {
        let state = match &self.second_term {
            SecondTerm::Envelope => {
                State { w: self.steady_state + self.slow_pole.amplitude * slow, u: Complex64::ZERO }
            }
            SecondTerm::FastPole { term, fixed } => {
                let (slow, fast) = (self.slow_pole.amplitude * slow, term.amplitude * second);
                let u = fixed.rest + fixed.poles[0] * slow + fixed.poles[1] * fast;
                State { w: self.steady_state + slow + fast, u }
            }
            SecondTerm::Ratio { rest, amplitude } => {
                let (in_phase, ratio) =
                    (self.steady_state.re + self.slow_pole.amplitude.re * slow.re, rest + amplitude * slow.re);
                State { w: Complex64::new(in_phase, in_phase * ratio), u: ratio.into() }
            }
        };
        state.flush_negligible()
    }

    pub fn steady_state(&self) -> Complex64 {
        self.steady_state
    }
}

impl ExponentialSum<2> for Flow {
    fn after(&self, seconds: f64) -> State {
        self.after(seconds)
    }

    fn excursion_bound(&self) -> ExcursionBound {
        // One square root instead of two calls of `hypot`, which took 10 % of a trial's time.
        let speed = |term: &ExponentialTerm| (term.amplitude.norm_sqr() * term.pole.norm_sqr()).sqrt();
        let slow = speed(&self.slow_pole);
        match &self.second_term {
            SecondTerm::Envelope => ExcursionBound { speed: slow, ripple: 0.0, ripple_speed: 0.0 },
            SecondTerm::FastPole { term, .. } => ExcursionBound {
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

    fn terms(&self) -> (Complex64, [Term; 2]) {
        let slow = (self.slow_pole.amplitude, self.slow_pole.pole);
        let other = match &self.second_term {
            SecondTerm::Envelope => (Complex64::ZERO, Complex64::ZERO),
            SecondTerm::FastPole { term, .. } => (term.amplitude, term.pole),
            // W = (Wd∞ + a e)(1 + j (r∞ + c e)) with e = e^{−σt}.
            SecondTerm::Ratio { rest, amplitude } => {
                let first = slow.0 * (1.0 + J * rest) + J * *amplitude * self.steady_state.re;
                return (self.steady_state, [(first, slow.1), (slow.0 * J * *amplitude, 2.0 * slow.1)]);
            }
        };
        (self.steady_state, [slow, other])
    }
}

/// Output of the amplifier, `constant + slope t + decaying e^{−rate t}`. `slope` is in Vpp/s,
/// `rate` in 1/s, the other fields are in Vpp.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Forcing {
    pub(crate) constant: f64,
    pub(crate) slope: f64,
    pub(crate) decaying: f64,
    pub(crate) rate: f64,
}

impl Forcing {
    pub(crate) fn at(&self, seconds: f64) -> f64 {
        self.constant + self.slope * seconds + self.decaying * (-self.rate * seconds).exp()
    }

    /// The same output with its time origin moved to `seconds`.
    pub(crate) fn from(&self, seconds: f64) -> Self {
        Self {
            constant: self.constant + self.slope * seconds,
            decaying: self.decaying * (-self.rate * seconds).exp(),
            ..*self
        }
    }
}

/// Flow of one mode under an amplifier's output `V(t) = c + m t + a e^{−rt}`.
///
/// The response to a drive `e^{st}` is `H(s) e^{st}` with `H(s) = j(N/m)/((q − s₊)(q − s₋))`,
/// `q = s + jω`. The response to the ramp t is `H(0) t + H'(0)`, with
/// `H'/H = −1/(q − s₊) − 1/(q − s₋)`. The rest of the state decays with both poles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ForcedFlow {
    omega: f64,
    rest: Complex64,
    /// Slope of the response to the ramp, µm/s.
    slope: Complex64,
    /// Terms of slow pole, fast pole and amplifier; rotating frame.
    terms: [Term; 3],
}

impl ForcedFlow {
    pub(crate) fn new(mode: &Mode, omega: f64, forcing: &Forcing, state: &State) -> Self {
        let Mode { sigma, omega0, .. } = *mode;
        let frame = J * omega;
        let damped = ((omega0 - sigma) * (omega0 + sigma)).sqrt();
        let (plus, minus) = (Complex64::new(-sigma, damped), Complex64::new(-sigma, -damped));
        let stiffness = Complex64::new((omega0 - omega) * (omega0 + omega), 2.0 * sigma * omega);
        let response = J * mode.force_constant / stiffness;
        let slope = response * forcing.slope;
        let rest = response * forcing.constant - slope * ((frame - plus).inv() + (frame - minus).inv());
        let mut rate = forcing.rate;
        if (frame - rate - plus).norm() < MIN_POLE_DISTANCE * rate {
            rate *= 1.0 + MIN_POLE_DISTANCE;
        }
        let drive = frame - rate;
        let amplifier = J * (mode.force_constant * forcing.decaying) / ((drive - plus) * (drive - minus));
        let w = state.w - rest - amplifier;
        let u = state.u - frame * rest - slope - drive * amplifier;
        let slow = (u - minus * w) / (plus - minus);
        Self {
            omega,
            rest,
            slope,
            terms: [(slow, plus - frame), (w - slow, minus - frame), (amplifier, Complex64::from(-rate))],
        }
    }
}

impl ExponentialSum<3> for ForcedFlow {
    fn after(&self, seconds: f64) -> State {
        let frame = J * self.omega;
        let mut w = self.rest + self.slope * seconds;
        let mut u = frame * w + self.slope;
        for (amplitude, pole) in self.terms {
            let term = amplitude * (pole * seconds).exp();
            w += term;
            u += (pole + frame) * term;
        }
        State { w, u }.flush_negligible()
    }

    fn excursion_bound(&self) -> ExcursionBound {
        let [slow, fast, amplifier] = self.terms.map(|(amplitude, pole)| amplitude.norm() * pole.norm());
        let [_, (ripple, _), _] = self.terms;
        ExcursionBound { speed: slow + amplifier + self.slope.norm(), ripple: 2.0 * ripple.norm(), ripple_speed: fast }
    }

    fn terms(&self) -> (Complex64, [Term; 3]) {
        (self.rest, self.terms)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_ordered_and_found_by_name() {
        for model in Model::ALL {
            assert_eq!(Model::from_name(model.name()), Some(model));
        }
        assert!(Model::ALL.is_sorted());
        assert_eq!(Model::from_name("Modal"), None);
        assert_eq!(Model::default(), Model::Modal);
    }
}
