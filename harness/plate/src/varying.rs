//! Propagates the plate while a finger or the temperature changes its mode.
//!
//! Over a step, σ and ω0 follow a parabola each. Every model is transformed to scalar equations
//! `x' = λ(t)x + g(t)`, one per pole. The first two terms of the Magnus series solve each of them
//! (Blanes, Casas, Oteo, Ros, "The Magnus expansion and some of its applications", Physics Reports
//! 470, 2009). With λ the mean over the step t, λ' its slope and `E = e^{λt}`,
//!
//! `x(t) = E x + g ((E − 1)/λ + λ' G)`, `G = (λt/2 (E + 1) − (E − 1))/λ³ = t³/12 + …`.
//!
//! The free motion is exact to this order. The forced motion has the error `λ'² t⁵/240 · g`. A
//! force `g + g's`, with s the time from the middle of the step, adds `−g'λ G`. Under a force
//! `g e^{−rt}`, the variable `x e^{rt}` has the constant force g and the pole `λ + r`.
//!
//! The transformation of Liouville and Green (Olver, "Asymptotics and Special Functions", chapter
//! 6) decouples the poles of the second-order plate. With
//! `Ω² = ω0² − σ² − σ' + ¾(ω0'/ω0)² − ω0''/2ω0` and `v = U + (σ + Ω'/2Ω)W`, each of the amplitudes
//! `√Ω (W ∓ jv/Ω)/2` has one of the poles `−σ ± jΩ − jω`, so no step excites the fast pole.
//! `docs/mathematics.md` derives the error.

use crate::flow::{Forcing, Model, State};
use crate::mode::{Drive, Mode};
use num_complex::Complex64;

const J: Complex64 = Complex64::I;

/// Parameter at the time t of a step: `start + slope t + curvature t²`.
#[derive(Debug, Clone, Copy)]
struct Parabola {
    start: f64,
    slope: f64,
    curvature: f64,
}

impl Parabola {
    /// The parabola through three values, the first at 0 s.
    fn through([first, middle, last]: [f64; 3], [middle_at, last_at]: [f64; 2]) -> Self {
        let slope = (middle - first) / middle_at;
        let bend = ((last - first) / last_at - slope) / (last_at - middle_at);
        Self { start: first, slope: slope - bend * middle_at, curvature: bend }
    }

    fn at(&self, t: f64) -> f64 {
        self.start + t * (self.slope + t * self.curvature)
    }

    fn slope_at(&self, t: f64) -> f64 {
        self.slope + 2.0 * t * self.curvature
    }

    /// Mean from 0 to t.
    fn mean(&self, t: f64) -> f64 {
        self.start + t * (self.slope / 2.0 + t * self.curvature / 3.0)
    }

    fn mean_slope(&self, t: f64) -> f64 {
        self.slope + t * self.curvature
    }

    fn max_change(&self, t: f64) -> f64 {
        t * (self.slope.abs() + t * self.curvature.abs())
    }
}

/// Frequency Ω of the free oscillation in rad/s, its slope Ω' in rad/s², and `σ + Ω'/2Ω` in 1/s.
#[derive(Debug, Clone, Copy)]
struct Oscillation {
    omega: f64,
    slope: f64,
    shear: f64,
}

/// E, `(E − 1)/λ` and G of the module's equations, for one pole.
#[derive(Debug, Clone, Copy)]
struct PoleStep {
    free: Complex64,
    forced: Complex64,
    commutator: Complex64,
}

impl PoleStep {
    fn new(pole: Complex64, t: f64) -> Self {
        let x = pole * t;
        let free = x.exp();
        let rise = free - 1.0;
        let commutator = if x.norm_sqr() < 0.1 {
            // The closed form loses digits for small x. The series has a relative error of 3e-6.
            t.powi(3) * (((x / 2016.0 + 1.0 / 360.0) * x + 1.0 / 80.0) * x * x + x / 24.0 + 1.0 / 12.0)
        } else {
            (x / 2.0 * (free + 1.0) - rise) / (pole * pole * pole)
        };
        Self { free, forced: rise / pole, commutator }
    }

    /// Response to `e^{−rate t}`: the response of the pole `λ + rate` to 1, times `e^{−rate t}`.
    fn decaying(pole: Complex64, rate: f64, t: f64) -> Self {
        let shifted = pole + rate;
        let (free, decay) = ((pole * t).exp(), (-rate * t).exp());
        let x = shifted * t;
        let forced = if x.norm_sqr() < 1e-16 { decay * t * (1.0 + x / 2.0) } else { (free - decay) / shifted };
        let commutator = if x.norm_sqr() < 0.1 {
            decay * t.powi(3) * (((x / 2016.0 + 1.0 / 360.0) * x + 1.0 / 80.0) * x * x + x / 24.0 + 1.0 / 12.0)
        } else {
            (x / 2.0 * (free + decay) - (free - decay)) / (shifted * shifted * shifted)
        };
        Self { free, forced, commutator }
    }
}

/// Response of one pole to ramp and decaying part of the drive, per unit of force. The pole has the
/// rate `pole_slope`, the force changes by the fraction `−force_slope` per second.
fn forced_part(forcing: &Forcing, pole: Complex64, pole_slope: Complex64, force_slope: f64, t: f64) -> Complex64 {
    let Forcing { slope: ramp, decaying, rate, .. } = *forcing;
    let passage = PoleStep::new(pole, t);
    let total = pole_slope + pole * force_slope;
    // Response to the ramp's mean over the step, plus the response to its slope around the mean.
    let ramp = ramp * t / 2.0 * (passage.forced + total * passage.commutator) - ramp * pole * passage.commutator;
    let decay = PoleStep::decaying(pole, rate, t);
    let total = pole_slope + (pole + rate) * force_slope;
    ramp + decaying * (decay.forced + total * decay.commutator)
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct VaryingFlow {
    model: Model,
    drive: Drive,
    state: State,
    force_constant: f64,
    envelope_constant: f64,
    sigma: Parabola,
    omega0: Parabola,
}

impl VaryingFlow {
    /// The modes are those at 0 s and at `times` in s.
    pub(crate) fn new(model: Model, modes: [Mode; 3], times: [f64; 2], drive: &Drive, state: &State) -> Self {
        let through = |of: fn(&Mode) -> f64| Parabola::through(modes.each_ref().map(of), times);
        let [first, ..] = modes;
        Self {
            model,
            drive: *drive,
            state: *state,
            force_constant: first.force_constant,
            envelope_constant: first.envelope_constant,
            sigma: through(|mode| mode.sigma),
            omega0: through(|mode| mode.omega0),
        }
    }

    pub(crate) fn after(&self, seconds: f64) -> State {
        let state = match self.model {
            Model::Linear => self.linear(seconds),
            Model::Envelope => self.envelope(seconds),
            Model::Modal | Model::Carrier => self.modal(seconds),
        };
        state.flush_negligible()
    }

    /// Upper bound on |ΔW| in µm, from the initial speed of W and the change of the pole.
    pub(crate) fn max_excursion(&self, seconds: f64) -> f64 {
        let State { w, u } = self.state;
        let force = self.envelope_constant * self.drive.vpp;
        let (damping, detuning) = (self.sigma.start, self.omega0.start - self.drive.omega);
        let (damping_swing, detuning_swing) = (self.sigma.max_change(seconds), self.omega0.max_change(seconds));
        let swing = damping_swing + detuning_swing;
        match self.model {
            Model::Linear => {
                let in_phase = seconds * ((force - damping * w.re).abs() + damping_swing * w.re.abs());
                let turned = damping_swing * u.re.abs() + detuning_swing;
                let ratio = seconds * ((detuning - damping * u.re).abs() + turned);
                in_phase * (1.0 + u.re.abs()) + (w.re.abs() + in_phase) * ratio
            }
            Model::Envelope => seconds * ((Complex64::new(-damping, detuning) * w + force).norm() + swing * w.norm()),
            Model::Modal | Model::Carrier => {
                let now = self.oscillation(0.0);
                let (slow, fast) = self.pole_amplitudes(now);
                let force = self.force_constant * self.drive.vpp / (2.0 * now.omega);
                let pole = Complex64::new(-damping, now.omega - self.drive.omega);
                let slow_reach = seconds * ((pole * slow + force).norm() + swing * (slow.norm() + force / now.omega));
                let fast_reach = 2.0 * (fast.norm() + force / (now.omega + self.drive.omega));
                // The factor allows for the change of Ω, which scales both terms, by 1 %.
                1.01 * (slow_reach + fast_reach) + swing / now.omega * w.norm()
            }
        }
    }

    fn envelope(&self, t: f64) -> State {
        let pole = Complex64::new(-self.sigma.mean(t), self.omega0.mean(t) - self.drive.omega);
        let slope = Complex64::new(-self.sigma.mean_slope(t), self.omega0.mean_slope(t));
        let passage = PoleStep::new(pole, t);
        let response = passage.forced + slope * passage.commutator;
        State {
            w: passage.free * self.state.w + self.envelope_constant * self.drive.vpp * response,
            u: Complex64::ZERO,
        }
    }

    fn linear(&self, t: f64) -> State {
        let (damping, slope) = (self.sigma.mean(t), -self.sigma.mean_slope(t));
        let PoleStep { free, forced, commutator } = PoleStep::new((-damping).into(), t);
        let (free, forced, commutator) = (free.re, forced.re, commutator.re);
        let response = forced + slope * commutator;
        let in_phase = free * self.state.w.re + self.envelope_constant * self.drive.vpp * response;
        // The detuning is the force of the ratio's equation, and it changes with ω0.
        let drift = self.omega0.mean_slope(t) * damping * commutator;
        let ratio = free * self.state.u.re + (self.omega0.mean(t) - self.drive.omega) * response + drift;
        State { w: Complex64::new(in_phase, in_phase * ratio), u: ratio.into() }
    }

    fn modal(&self, t: f64) -> State {
        let (start, middle, end) = (self.oscillation(0.0), self.oscillation(t / 2.0), self.oscillation(t));
        let omega = (start.omega + 4.0 * middle.omega + end.omega) / 6.0;
        let slope = start.slope.midpoint(end.slope);
        let (damping, damping_slope) = (self.sigma.mean(t), self.sigma.mean_slope(t));
        let force = self.force_constant * self.drive.vpp / (2.0 * (omega * start.omega).sqrt());
        let moved = |amplitude: Complex64, side: f64| {
            let pole = Complex64::new(-damping, side * omega - self.drive.omega);
            let passage = PoleStep::new(pole, t);
            // The force is proportional to 1/√Ω.
            let slope = Complex64::new(-damping_slope, side * slope) + pole * (slope / (2.0 * omega));
            passage.free * amplitude + side * force * (passage.forced + slope * passage.commutator)
        };
        let (slow, fast) = self.pole_amplitudes(start);
        let (slow, fast) = (moved(slow, 1.0), moved(fast, -1.0));
        let scale = (start.omega / end.omega).sqrt();
        let w = scale * (slow + fast);
        State { w, u: J * (end.omega * scale) * (slow - fast) - end.shear * w }
    }

    /// Response of the modal plate at rest to ramp and decaying part of the drive. [`Self::after`]
    /// contains the response to the constant part.
    pub(crate) fn response_to(&self, forcing: &Forcing, t: f64) -> State {
        let (start, middle, end) = (self.oscillation(0.0), self.oscillation(t / 2.0), self.oscillation(t));
        let omega = (start.omega + 4.0 * middle.omega + end.omega) / 6.0;
        let (slope, damping) = (start.slope.midpoint(end.slope), self.sigma.mean(t));
        let unit = self.force_constant / (2.0 * (omega * start.omega).sqrt());
        let of_side = |side: f64| {
            let pole = Complex64::new(-damping, side * omega - self.drive.omega);
            let pole_slope = Complex64::new(-self.sigma.mean_slope(t), side * slope);
            side * unit * forced_part(forcing, pole, pole_slope, slope / (2.0 * omega), t)
        };
        let (slow, fast) = (of_side(1.0), of_side(-1.0));
        let scale = (start.omega / end.omega).sqrt();
        let w = scale * (slow + fast);
        State { w, u: J * (end.omega * scale) * (slow - fast) - end.shear * w }
    }

    /// State from which a modal plate with the constant `mode` has the amplitudes of the poles that
    /// this one has at 0 s.
    pub(crate) fn start_in(&self, mode: &Mode) -> State {
        let Mode { sigma, omega0, .. } = *mode;
        let damped = ((omega0 - sigma) * (omega0 + sigma)).sqrt();
        let (slow, fast) = self.pole_amplitudes(self.oscillation(0.0));
        let (plus, minus) = (Complex64::new(-sigma, damped), Complex64::new(-sigma, -damped));
        State { w: slow + fast, u: plus * slow + minus * fast }
    }

    /// Parts of W in µm with the frequencies `Ω − ω` and `−Ω − ω` in the rotating frame.
    fn pole_amplitudes(&self, now: Oscillation) -> (Complex64, Complex64) {
        let State { w, u } = self.state;
        let quadrature = -J * (u + now.shear * w) / now.omega;
        ((w + quadrature) / 2.0, (w - quadrature) / 2.0)
    }

    fn oscillation(&self, t: f64) -> Oscillation {
        let (sigma, sigma_slope) = (self.sigma.at(t), self.sigma.slope_at(t));
        let (omega0, omega0_slope) = (self.omega0.at(t), self.omega0.slope_at(t));
        let green = 0.75 * (omega0_slope / omega0).powi(2) - self.omega0.curvature / omega0;
        let omega = ((omega0 - sigma) * (omega0 + sigma) - sigma_slope + green).sqrt();
        let slope = (omega0 * omega0_slope - sigma * sigma_slope - self.sigma.curvature) / omega;
        Oscillation { omega, slope, shear: sigma + slope / (2.0 * omega) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const OMEGA0: f64 = 202_995.0;

    fn mode(sigma: f64, shift: f64) -> Mode {
        Mode { sigma, omega0: OMEGA0 + shift, force_constant: 1.5e6, envelope_constant: 3.71 }
    }

    fn varying(model: Model, modes: [(f64, f64); 3], drive: Drive, state: State) -> VaryingFlow {
        let modes = modes.map(|(sigma, shift)| mode(sigma, shift));
        VaryingFlow::new(model, modes, [0.5e-3, 1e-3], &drive, &state)
    }

    #[test]
    fn a_constant_mode_gives_the_closed_form() {
        let drive = Drive { vpp: 300.0, omega: OMEGA0 + 300.0 };
        for model in Model::ALL {
            let u = if model == Model::Linear { 0.5.into() } else { Complex64::new(3e5, 2e5) };
            let u = if model == Model::Envelope { Complex64::ZERO } else { u };
            let state = State { w: Complex64::new(1.0, 0.5), u };
            let varying = varying(model, [(532.0, 9.0); 3], drive, state);
            let flow = crate::flow::Flow::new(model, &mode(532.0, 9.0), &drive, &state);
            for seconds in [0.0, 1e-9, 1e-6, 1e-4, 1e-3] {
                let (ours, theirs) = (varying.after(seconds), flow.after(seconds));
                assert!((ours.w - theirs.w).norm() < 1e-13, "{} {seconds} {ours:?} {theirs:?}", model.name());
                assert!((ours.u - theirs.u).norm() < 1e-13 * OMEGA0, "{} {seconds} {ours:?} {theirs:?}", model.name());
            }
        }
    }

    #[test]
    fn the_series_of_g_is_continuous_with_its_closed_form() {
        let direction = Complex64::new(-0.6, 0.8);
        let [below, above] = [0.1_f64.sqrt() * 0.999_999, 0.1_f64.sqrt() * 1.000_001]
            .map(|x| PoleStep::new(direction * x / 1e-3, 1e-3).commutator / 1e-9);
        assert!((below - above).norm() < 1e-6, "{below} {above}");
        assert!((PoleStep::new((-1e-9).into(), 1.0).commutator - 1.0 / 12.0).norm() < 1e-9);
    }

    proptest! {
        #[test]
        fn the_change_of_w_stays_within_its_bound(
            model in prop::sample::select(&Model::ALL),
            sigmas in prop::array::uniform3(300.0..2_000.0),
            shifts in prop::array::uniform3(-600.0..600.0),
            vpp in 0.0..800.0,
            detuning in -2_000.0..2_000.0,
            w in prop::array::uniform2(-2.0..2.0),
            at_rest in any::<bool>(),
        ) {
            let modes = [0, 1, 2].map(|at| (sigmas[at], shifts[at]));
            let drive = Drive { vpp, omega: OMEGA0 + detuning };
            let mut w = Complex64::new(w[0], w[1]);
            if at_rest {
                // Start in the steady state of the first mode: only the change of the mode moves W.
                w = 3.71 * vpp / Complex64::new(sigmas[0], drive.omega - OMEGA0 - shifts[0]);
            }
            let u = match model {
                Model::Linear if at_rest => Complex64::from((shifts[0] - detuning) / sigmas[0]),
                Model::Linear => (w.im / w.re).clamp(-2.0, 2.0).into(),
                Model::Envelope => Complex64::ZERO,
                Model::Modal | Model::Carrier => J * drive.omega * w,
            };
            if model == Model::Linear {
                w = if at_rest { 3.71 * vpp / sigmas[0] } else { w.re } * Complex64::new(1.0, u.re);
            }
            let varying = varying(model, modes, drive, State { w, u });
            for step in 1..=100 {
                let seconds = 1e-5 * f64::from(step);
                let (gone, reach) = ((varying.after(seconds).w - w).norm(), varying.max_excursion(seconds));
                prop_assert!(gone <= reach, "{gone} µm after {seconds} s, reach {reach}");
            }
        }
    }
}
