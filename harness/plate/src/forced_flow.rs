//! Propagates one mode exactly under an amplifier's output `V(t) = c + m t + a e^{−rt}`.
//!
//! In the rotating frame of `flow.rs`, the response to a drive `e^{st}` is `H(s) e^{st}` with
//! `H(s) = j(N/m)/((q − s₊)(q − s₋))`, `q = s + jω`. The response to the ramp t is
//! `H(0) t + H'(0)`, with `H'/H = −1/(q − s₊) − 1/(q − s₋)`. The rest of the state decays with both
//! poles, as in `flow.rs`.

use crate::amplifier::Forcing;
use crate::flow::{ExcursionBound, State};
use crate::mode::Mode;
use num_complex::Complex64;

const J: Complex64 = Complex64::I;
/// Smallest relative distance between the poles of amplifier and plate. Below it the response is a
/// difference of nearly equal terms, so the amplifier's pole is moved.
const MIN_POLE_DISTANCE: f64 = 1e-8;

#[derive(Debug, Clone, Copy)]
pub(crate) struct ForcedFlow {
    omega: f64,
    rest: Complex64,
    /// Slope of the response to the ramp, µm/s.
    slope: Complex64,
    /// Amplitude in µm and pole in 1/s of slow pole, fast pole and amplifier; rotating frame.
    terms: [(Complex64, Complex64); 3],
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

    pub(crate) fn after(&self, seconds: f64) -> State {
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

    pub(crate) fn excursion_bound(&self) -> ExcursionBound {
        let [slow, fast, amplifier] = self.terms.map(|(amplitude, pole)| amplitude.norm() * pole.norm());
        let [_, (ripple, _), _] = self.terms;
        ExcursionBound { speed: slow + amplifier + self.slope.norm(), ripple: 2.0 * ripple.norm(), ripple_speed: fast }
    }

    /// W without the response to the ramp, `rest + Σ amplitude e^{pole t}`, as `rest` and pairs
    /// (amplitude in µm, pole in 1/s).
    pub(crate) fn terms(&self) -> (Complex64, [(Complex64, Complex64); 3]) {
        (self.rest, self.terms)
    }
}
