//! Defines the plate's equations for general integrators as a state vector and its rate.
//!
//! Velocities are divided by a fixed angular frequency near the carrier's (`scale`). Thus all
//! components are µm of similar size, and one tolerance suits all. If a right-hand side depends on
//! the time, the time is a component of the state (the clock), because `ode_solvers` 0.6.2 uses a
//! wrong node in the twelfth stage of DOP853. N/m is the plate's force constant
//! ([`Mode::force_constant`]), not a unit.

use platebench_plate::{Complex64, Drive, Mode, State};
use std::array::from_fn;

const J: Complex64 = Complex64::I;

/// The equations `x' = A x + b`. A and b are constant unless the state contains a clock.
pub trait Problem<const N: usize>: Copy {
    /// Index of the clock, the time in s since the start of the interval.
    const CLOCK: Option<usize> = None;

    fn rate(&self, x: &[f64; N]) -> [f64; N];

    /// A at the time of `x`, 1/s. Row and column of the clock are zero.
    fn matrix(&self, x: &[f64; N]) -> [[f64; N]; N];

    /// Parts of a splitting step of `step` s, with the mode at the time of `x`.
    fn split(&self, x: &[f64; N], step: f64) -> Split<N>;

    /// b at the time of `x`. The entry of the clock is zero.
    fn forcing(&self, x: &[f64; N]) -> [f64; N];

    /// Advances by a Störmer-Verlet step in s. `None` if the problem is not of second order in a
    /// real position.
    fn leapfrog(&self, _x: &[f64; N], _step: f64) -> Option<[f64; N]> {
        None
    }
}

/// Strang splitting of `x' = A x + b`. A is the sum of an undamped rotation and a diagonal damping.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Split<const N: usize> {
    /// Exact solution of the undamped oscillation over a step. The clock's row and column are zero.
    pub rotation: [[f64; N]; N],
    /// Exact solution of `x' = -d x + b` over half a step: `decay x + gain b`.
    pub decay: [f64; N],
    /// Factor of b over half a step, s.
    pub gain: [f64; N],
}

/// Returns decay and gain of `x' = -damping x + b` over `seconds`.
fn relaxation(damping: f64, seconds: f64) -> (f64, f64) {
    let change = (-damping * seconds).exp_m1();
    (1.0 + change, if damping == 0.0 { seconds } else { -change / damping })
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProblemParameters {
    pub mode: Mode,
    /// Change of σ, 1/s². `omega0_rate` is the change of ω0, rad/s².
    pub sigma_rate: f64,
    pub omega0_rate: f64,
    pub drive: Drive,
}

impl ProblemParameters {
    pub fn constant(mode: Mode, drive: Drive) -> Self {
        Self { mode, sigma_rate: 0.0, omega0_rate: 0.0, drive }
    }

    pub fn is_time_varying(&self) -> bool {
        self.sigma_rate != 0.0 || self.omega0_rate != 0.0
    }
}

pub trait ConstantMode<const N: usize>: Problem<N> {
    /// The problem with σ higher by `sigma` (1/s) and ω0 higher by `omega0` (rad/s).
    #[must_use]
    fn shifted(&self, sigma: f64, omega0: f64) -> Self;
}

/// A problem with σ and ω0 linear in time. The last component of its state is the clock.
#[derive(Debug, Clone, Copy)]
pub struct TimeVarying<P, const N: usize> {
    problem: P,
    sigma_rate: f64,
    omega0_rate: f64,
}

impl<P: ConstantMode<N>, const N: usize> TimeVarying<P, N> {
    pub fn new(problem: P, situation: &ProblemParameters) -> Self {
        Self { problem, sigma_rate: situation.sigma_rate, omega0_rate: situation.omega0_rate }
    }

    /// Returns the problem at the time of `x`, and `x` without the clock.
    #[inline]
    fn at<const M: usize>(&self, x: &[f64; M]) -> (P, [f64; N]) {
        (self.problem.shifted(self.sigma_rate * x[N], self.omega0_rate * x[N]), from_fn(|i| x[i]))
    }
}

/// The state has M = N + 1 components, because the clock is added.
impl<P: ConstantMode<N>, const N: usize, const M: usize> Problem<M> for TimeVarying<P, N> {
    const CLOCK: Option<usize> = Some(N);

    #[inline]
    fn rate(&self, x: &[f64; M]) -> [f64; M] {
        let (problem, x) = self.at(x);
        with_clock(problem.rate(&x), 1.0)
    }

    fn matrix(&self, x: &[f64; M]) -> [[f64; M]; M] {
        let (problem, x) = self.at(x);
        with_clock_row(&problem.matrix(&x))
    }

    fn split(&self, x: &[f64; M], step: f64) -> Split<M> {
        let (problem, x) = self.at(x);
        let Split { rotation, decay, gain } = problem.split(&x, step);
        Split { rotation: with_clock_row(&rotation), decay: with_clock(decay, 1.0), gain: with_clock(gain, 0.0) }
    }

    #[inline]
    fn forcing(&self, x: &[f64; M]) -> [f64; M] {
        let (problem, x) = self.at(x);
        with_clock(problem.forcing(&x), 0.0)
    }
}

/// Envelope `W' = λW + bV`, `λ = −σ − j(ω − ω0)`. The state is `[Re W, Im W]`, µm.
#[derive(Debug, Clone, Copy)]
pub struct EnvelopeProblem {
    sigma: f64,
    omega0: f64,
    omega: f64,
    force: f64,
}

impl EnvelopeProblem {
    pub fn new(situation: &ProblemParameters) -> Self {
        let Mode { sigma, omega0, envelope_constant, .. } = situation.mode;
        Self { sigma, omega0, omega: situation.drive.omega, force: envelope_constant * situation.drive.vpp }
    }

    pub fn pack(state: &State) -> [f64; 2] {
        [state.w.re, state.w.im]
    }

    pub fn unpack(x: &[f64; 2]) -> State {
        State { w: Complex64::new(x[0], x[1]), u: Complex64::ZERO }
    }
}

impl Problem<2> for EnvelopeProblem {
    #[inline]
    fn rate(&self, x: &[f64; 2]) -> [f64; 2] {
        let detuning = self.omega - self.omega0;
        [self.force - self.sigma * x[0] + detuning * x[1], -detuning * x[0] - self.sigma * x[1]]
    }

    fn matrix(&self, _: &[f64; 2]) -> [[f64; 2]; 2] {
        let detuning = self.omega - self.omega0;
        [[-self.sigma, detuning], [-detuning, -self.sigma]]
    }

    fn split(&self, _: &[f64; 2], step: f64) -> Split<2> {
        let (sin, cos) = ((self.omega - self.omega0) * step).sin_cos();
        let (decay, gain) = relaxation(self.sigma, 0.5 * step);
        Split { rotation: [[cos, sin], [-sin, cos]], decay: [decay; 2], gain: [gain; 2] }
    }

    #[inline]
    fn forcing(&self, _: &[f64; 2]) -> [f64; 2] {
        [self.force, 0.0]
    }
}

impl ConstantMode<2> for EnvelopeProblem {
    #[inline]
    fn shifted(&self, sigma: f64, omega0: f64) -> Self {
        Self { sigma: self.sigma + sigma, omega0: self.omega0 + omega0, ..*self }
    }
}

/// Modal equations `W' = U − jωW`, `U' = −jωU − 2σU − ω0²W + j(N/m)V`. The state is `[Re W, Im W,
/// Re U/scale, Im U/scale]`, µm.
#[derive(Debug, Clone, Copy)]
pub struct ModalProblem {
    sigma: f64,
    omega0: f64,
    omega: f64,
    force: f64,
    scale: f64,
}

impl ModalProblem {
    /// `scale` in rad/s.
    pub fn new(situation: &ProblemParameters, scale: f64) -> Self {
        let Mode { sigma, omega0, force_constant, .. } = situation.mode;
        Self { sigma, omega0, omega: situation.drive.omega, force: force_constant * situation.drive.vpp, scale }
    }

    pub fn pack(state: &State, scale: f64) -> [f64; 4] {
        [state.w.re, state.w.im, state.u.re / scale, state.u.im / scale]
    }

    pub fn unpack(x: &[f64; 4], scale: f64) -> State {
        State { w: Complex64::new(x[0], x[1]), u: Complex64::new(x[2], x[3]) * scale }
    }
}

impl Problem<4> for ModalProblem {
    #[inline]
    fn rate(&self, x: &[f64; 4]) -> [f64; 4] {
        let Self { sigma, omega0, omega, force, scale } = *self;
        let (damping, stiffness) = (2.0 * sigma, omega0 * omega0 / scale);
        [
            scale * x[2] + omega * x[1],
            scale * x[3] - omega * x[0],
            omega * x[3] - damping * x[2] - stiffness * x[0],
            force / scale - omega * x[2] - damping * x[3] - stiffness * x[1],
        ]
    }

    fn matrix(&self, _: &[f64; 4]) -> [[f64; 4]; 4] {
        let Self { sigma, omega0, omega, scale, .. } = *self;
        let (damping, stiffness) = (2.0 * sigma, omega0 * omega0 / scale);
        [
            [0.0, omega, scale, 0.0],
            [-omega, 0.0, 0.0, scale],
            [-stiffness, 0.0, -damping, omega],
            [0.0, -stiffness, -omega, -damping],
        ]
    }

    fn split(&self, _: &[f64; 4], step: f64) -> Split<4> {
        let Self { sigma, omega0, omega, scale, .. } = *self;
        let (sin, cos) = (omega0 * step).sin_cos();
        // The frame turns W and U by −ωh. The oscillation acts equally on real and imaginary parts.
        let (s, c) = (omega * step).sin_cos();
        let (up, down) = (sin * scale / omega0, -sin * omega0 / scale);
        let rotation = [
            [cos * c, cos * s, up * c, up * s],
            [-cos * s, cos * c, -up * s, up * c],
            [down * c, down * s, cos * c, cos * s],
            [-down * s, down * c, -cos * s, cos * c],
        ];
        let (decay, gain) = relaxation(2.0 * sigma, 0.5 * step);
        Split { rotation, decay: [1.0, 1.0, decay, decay], gain: [0.0, 0.0, gain, gain] }
    }

    #[inline]
    fn forcing(&self, _: &[f64; 4]) -> [f64; 4] {
        [0.0, 0.0, 0.0, self.force / self.scale]
    }
}

impl ConstantMode<4> for ModalProblem {
    #[inline]
    fn shifted(&self, sigma: f64, omega0: f64) -> Self {
        Self { sigma: self.sigma + sigma, omega0: self.omega0 + omega0, ..*self }
    }
}

/// Equation 1 of the paper, `y'' + 2σy' + ω0²y = (N/m) v(t)`, with `v = Re(jV e^{jθ})`. The state
/// is `[y, y'/scale, time]`, µm and s.
#[derive(Debug, Clone, Copy)]
pub struct CarrierProblem {
    sigma: f64,
    omega0: f64,
    sigma_rate: f64,
    omega0_rate: f64,
    omega: f64,
    theta: f64,
    force: f64,
    scale: f64,
}

impl CarrierProblem {
    /// `theta` is the phase of the excitation at the start in rad, `scale` is in rad/s.
    pub fn new(situation: &ProblemParameters, theta: f64, scale: f64) -> Self {
        let ProblemParameters { mode, sigma_rate, omega0_rate, drive } = *situation;
        let Mode { sigma, omega0, force_constant, .. } = mode;
        let force = force_constant * drive.vpp;
        Self { sigma, omega0, sigma_rate, omega0_rate, omega: drive.omega, theta, force, scale }
    }

    pub fn pack(state: &State, theta: f64, scale: f64) -> [f64; 3] {
        let ahead = Complex64::cis(theta);
        [(state.w * ahead).re, (state.u * ahead).re / scale, 0.0]
    }

    /// The phasor `(y − jy'/ω) e^{−jθ}`: W plus a ripple, which y and y' alone cannot separate.
    pub fn phasor(&self, x: &[f64; 3]) -> Complex64 {
        let theta = self.theta + self.omega * x[2];
        (x[0] - J * (x[1] * self.scale / self.omega)) * Complex64::cis(-theta)
    }

    #[inline]
    fn mode_at(&self, t: f64) -> (f64, f64) {
        (self.sigma + self.sigma_rate * t, self.omega0 + self.omega0_rate * t)
    }

    /// `(N/m) v(t)`, µm/s².
    #[inline]
    fn drive_at(&self, t: f64) -> f64 {
        -self.force * (self.theta + self.omega * t).sin()
    }
}

impl Problem<3> for CarrierProblem {
    const CLOCK: Option<usize> = Some(2);

    #[inline]
    fn rate(&self, x: &[f64; 3]) -> [f64; 3] {
        let (sigma, omega0) = self.mode_at(x[2]);
        let pull = self.drive_at(x[2]) - omega0 * omega0 * x[0];
        [self.scale * x[1], pull / self.scale - 2.0 * sigma * x[1], 1.0]
    }

    fn matrix(&self, x: &[f64; 3]) -> [[f64; 3]; 3] {
        let (sigma, omega0) = self.mode_at(x[2]);
        [[0.0, self.scale, 0.0], [-omega0 * omega0 / self.scale, -2.0 * sigma, 0.0], [0.0; 3]]
    }

    fn split(&self, x: &[f64; 3], step: f64) -> Split<3> {
        let (sigma, omega0) = self.mode_at(x[2]);
        let (sin, cos) = (omega0 * step).sin_cos();
        let rotation = [[cos, sin * self.scale / omega0, 0.0], [-sin * omega0 / self.scale, cos, 0.0], [0.0; 3]];
        let (decay, gain) = relaxation(2.0 * sigma, 0.5 * step);
        Split { rotation, decay: [1.0, decay, 1.0], gain: [0.0, gain, 0.0] }
    }

    #[inline]
    fn forcing(&self, x: &[f64; 3]) -> [f64; 3] {
        [0.0, self.drive_at(x[2]) / self.scale, 0.0]
    }

    /// Kick-drift-kick with the damping at the middle:
    /// `(y₊ − 2y + y₋)/h² + 2σ(y₊ − y₋)/2h + ω0²y = (N/m)v`.
    #[inline]
    fn leapfrog(&self, x: &[f64; 3], step: f64) -> Option<[f64; 3]> {
        let [y, v, t] = *x;
        let half = 0.5 * step;
        let pull = |y: f64, t: f64| {
            let (sigma, omega0) = self.mode_at(t);
            (sigma, (self.drive_at(t) - omega0 * omega0 * y) / self.scale)
        };
        let (sigma, first) = pull(y, t);
        let middle = (v + half * first) / (1.0 + sigma * step);
        let after = y + step * self.scale * middle;
        let (sigma, second) = pull(after, t + step);
        Some([after, middle * (1.0 - sigma * step) + half * second, t + step])
    }
}

/// Appends the clock, so M = N + 1.
#[inline]
pub fn with_clock<const N: usize, const M: usize>(x: [f64; N], clock: f64) -> [f64; M] {
    from_fn(|i| x.get(i).copied().unwrap_or(clock))
}

fn with_clock_row<const N: usize, const M: usize>(inner: &[[f64; N]; N]) -> [[f64; M]; M] {
    from_fn(|row| inner.get(row).map_or([0.0; M], |values| with_clock(*values, 0.0)))
}
