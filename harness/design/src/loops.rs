//! Analyses the loop of a law and a plate in the z plane: poles, margins, boundaries, and the
//! response to a step. Amplitudes are in µm and voltages in Vpp, both peak to peak. Times are in s,
//! angular frequencies in rad/s.
//!
//! **Plant.** Both models are linear in W; only the product of W and ω is not. Around a steady state
//! W0 at drive V0 and excitation ω a small δω acts on the envelope as `−jW0 δω`. The envelope has
//! the equation `δW' = λ δW + b δV − jW0 δω` with one pole `λ = −σ − jΔω` (at resonance equations
//! 13 and 19). The modal model has the poles `s± − jω`, each with its share of `jN/m δV` on U and of
//! `−j(W0, U0) δω` on both states. Between two actuations each pole has the closed form `x(h) =
//! e^{sh} x + φ(h) u`, `φ = (e^{sh} − 1)/s`. Therefore sampling is exact for any part of a period.
//!
//! **Closed loop.** Plant, pending commands and integrals are one real matrix per period. A command
//! computed at k acts from `kTs + delay`. With `delay = m Ts + r`, u(k−m−1) acts for the first `r`
//! of a period, then u(k−m). The state is `[re, im of each pole | u(k−1), u(k−2) … | integrals]`, u
//! = (drive, frequency).

use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{DMatrix, Matrix2, Schur, Vector2};
use platebench_controller::design;
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{Complex64, Drive, Flow, Mode, Model, State};
use platebench_verdict::statistics::{bisect, try_bisect};
use schemars::JsonSchema;
use std::collections::VecDeque;
use std::f64::consts::PI;

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
    pub fn linearised_at(model: Model, mode: &Mode, drive: &Drive) -> Self {
        let at = steady_state(model, mode, drive);
        let j = Complex64::I;
        let poles = match model {
            // In this model Wd and Wq are decoupled: detuning has no effect, both decay with σ.
            Model::Linear => vec![Pole {
                value: (-mode.sigma).into(),
                drive_gain: mode.envelope_constant.into(),
                frequency_gain: -j * at.re,
            }],
            Model::Envelope => vec![Pole {
                value: Complex64::new(-mode.sigma, mode.omega0 - drive.omega),
                drive_gain: mode.envelope_constant.into(),
                frequency_gain: -j * at,
            }],
            Model::Modal | Model::Carrier => {
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

pub fn steady_state(model: Model, mode: &Mode, drive: &Drive) -> Complex64 {
    Flow::new(model, mode, drive, &State::default()).steady_state()
}

/// `u = proportional · e + x`, then `x += integral_per_period · e`. The firmware's type in f64.
pub type PiGains = design::PiGains<f64>;

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Discretisation {
    /// Equation 24 as printed, with a forward-Euler integral: `u = Kp e + x`, then `x += Ki Ts e`.
    Forward,
    /// Equation 24 as printed, with a backward-Euler integral: `x += Ki Ts e`, then `u = Kp e + x`.
    Backward,
    /// Matched to the zero-order hold. The zero of the PI is the sampled pole of the plant.
    Matched,
}

impl Discretisation {
    pub const ALL: [Self; 3] = [Self::Forward, Self::Backward, Self::Matched];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward Euler, as printed",
            Self::Backward => "backward Euler, as printed",
            Self::Matched => "zero-order-hold match",
        }
    }

    /// Gains by equation 24 for the plant K/(1 + τp). `gain` is K, all times are in s.
    pub fn gains(self, gain: f64, time_constant: f64, response: f64, period: f64) -> PiGains {
        let printed = PiGains::as_printed(gain, time_constant, response, period);
        match self {
            Self::Forward => printed,
            // A backward integral equals a forward one with this larger proportional gain.
            Self::Backward => PiGains { proportional: printed.proportional + printed.integral_per_period, ..printed },
            Self::Matched => PiGains::zero_order_hold_matched(gain, time_constant, response, period),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopChannel {
    pub pi: PiGains,
    /// Change of the error per µm of Wd and per µm of Wq.
    pub error_weights: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinearController {
    pub drive: Option<LoopChannel>,
    pub frequency: Option<LoopChannel>,
    /// Feedforward of the drive, Vpp per µm of setpoint.
    pub feedforward: f64,
}

impl LinearController {
    /// Matrices of `u = direct · y + x` and `x += integral · y` for a deviation y = (Wd, Wq).
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

    pub(crate) fn closed_channels(&self) -> [bool; 2] {
        [self.drive.is_some(), self.frequency.is_some()]
    }
}

/// Iteration limit of the eigenvalue solver, which usually needs two or three per state.
const ITERATIONS_PER_STATE: usize = 100;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopTiming {
    /// Control period Ts, s, above 0.
    pub period: f64,
    /// Delay from sampling to actuation, s. It may exceed a period.
    pub delay: f64,
}

impl LoopTiming {
    /// Returns the whole periods of the delay, and the rest in s.
    pub(crate) fn split_delay(&self) -> (usize, f64) {
        let whole = (self.delay / self.period).floor();
        let rest = self.delay - whole * self.period;
        if rest < 1e-9 * self.period {
            (whole as usize, 0.0)
        } else if rest > (1.0 - 1e-9) * self.period {
            (whole as usize + 1, 0.0)
        } else {
            (whole as usize, rest)
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LoopError {
    #[error("the loop analysis needs finite gains, a period above 0 and a finite delay of at least 0")]
    NotFinite,
    #[error("the eigenvalue solver did not converge, so the poles of the control loop are unknown")]
    NoConvergence,
}

#[derive(Debug, Clone)]
pub struct ClosedLoop {
    pub(crate) plant: LinearPlant,
    pub(crate) controller: LinearController,
    pub(crate) timing: LoopTiming,
    /// Maps the state to the state one period later, without a new command.
    free_motion: DMatrix<f64>,
    inputs: DMatrix<f64>,
    outputs: DMatrix<f64>,
}

impl ClosedLoop {
    pub fn new(plant: LinearPlant, controller: LinearController, timing: LoopTiming) -> Result<Self, LoopError> {
        let usable = timing.period > 0.0 && timing.delay >= 0.0 && (timing.delay / timing.period).is_finite();
        if !usable {
            return Err(LoopError::NotFinite);
        }
        let (whole, rest) = timing.split_delay();
        let on_the_way = whole + usize::from(rest > 0.0);
        let poles = plant.poles().len();
        let (pipe, integrals) = (2 * poles, 2 * poles + 2 * on_the_way);
        let size = integrals + 2;
        let mut free = DMatrix::zeros(size, size);
        let mut inputs = DMatrix::zeros(size, 2);
        let mut outputs = DMatrix::zeros(2, size);
        let [direct, integral] = controller.matrices();
        for (n, pole) in plant.poles().iter().enumerate() {
            let Complex64 { re, im } = pole.transition(timing.period);
            let (row, late) = (2 * n, pole.transition(timing.period - rest));
            free.view_mut((row, row), (2, 2)).copy_from_slice(&[re, im, -im, re]);
            let recent = pole.input_effects(timing.period - rest);
            for (kind, push) in recent.into_iter().enumerate() {
                add_command_effect(&mut free, &mut inputs, row, (whole, pipe, kind), push);
            }
            if rest > 0.0 {
                for (kind, push) in pole.input_effects(rest).into_iter().enumerate() {
                    add_command_effect(&mut free, &mut inputs, row, (whole + 1, pipe, kind), late * push);
                }
            }
            outputs.view_mut((0, row), (2, 2)).copy_from(&direct);
            free.view_mut((integrals, row), (2, 2)).copy_from(&integral);
        }
        for kind in 0..2 {
            if on_the_way > 0 {
                inputs[(pipe + kind, kind)] = 1.0;
            }
            for step in 1..on_the_way {
                free[(pipe + 2 * step + kind, pipe + 2 * (step - 1) + kind)] = 1.0;
            }
            // An open loop has no integral, because an unused integral would add a pole at 1.
            let closed = f64::from(u8::from(controller.closed_channels()[kind]));
            free[(integrals + kind, integrals + kind)] = closed;
            outputs[(kind, integrals + kind)] = closed;
        }
        let all = free.iter().chain(inputs.iter()).chain(outputs.iter());
        if all.into_iter().all(|value| value.is_finite()) {
            Ok(Self { plant, controller, timing, free_motion: free, inputs, outputs })
        } else {
            Err(LoopError::NotFinite)
        }
    }

    pub fn matrix(&self) -> DMatrix<f64> {
        &self.free_motion + &self.inputs * &self.outputs
    }

    /// Poles in the z plane. The poles of pending commands are at or near 0.
    pub fn poles(&self) -> Result<Vec<Complex64>, LoopError> {
        let matrix = self.matrix();
        let mut balanced = matrix.clone();
        balance_parlett_reinsch(&mut balanced);
        let limit = ITERATIONS_PER_STATE * matrix.nrows();
        // For a few matrices the solver does not converge. The transpose has the same eigenvalues.
        let forms = [balanced.clone(), balanced.transpose(), matrix.clone(), matrix.transpose()];
        let schur = forms.into_iter().find_map(|form| Schur::try_new(form, f64::EPSILON, limit));
        Ok(schur.ok_or(LoopError::NoConvergence)?.complex_eigenvalues().iter().copied().collect())
    }

    /// Largest magnitude of a pole. The loop is stable if this is below 1.
    pub fn spectral_radius(&self) -> Result<f64, LoopError> {
        Ok(self.poles()?.iter().fold(0.0, |largest, pole| pole.norm().max(largest)))
    }

    /// Open-loop L(z) of the drive loop (`kind` 0) or the frequency loop (1) while the other loop
    /// is closed. `L = −1` at the poles of the closed loop. `None` if the loop does not exist. The
    /// returned function returns `None` at a pole of L.
    pub(crate) fn open_loop_transfer(&self, kind: usize) -> Option<impl Fn(Complex64) -> Option<Complex64>> {
        self.controller.closed_channels().get(kind).copied().filter(|closes| *closes)?;
        let other = 1 - kind;
        let matrix = &self.free_motion + self.inputs.column(other) * self.outputs.row(other);
        let complex = |matrix: &DMatrix<f64>| matrix.map(Complex64::from);
        let (matrix, size) = (complex(&matrix), matrix.nrows());
        let input = self.inputs.column(kind).map(Complex64::from);
        let output = self.outputs.row(kind).map(Complex64::from);
        Some(move |z: Complex64| {
            let resolvent = DMatrix::from_diagonal_element(size, size, z) - &matrix;
            let state = resolvent.lu().solve(&input)?;
            let value = -(&output * state).x;
            value.is_finite().then_some(value)
        })
    }
}

/// Adds the effect of a command computed `age` periods ago on the plant pole at `row`.
fn add_command_effect(
    free: &mut DMatrix<f64>,
    inputs: &mut DMatrix<f64>,
    row: usize,
    (age, pipe, kind): (usize, usize, usize),
    push: Complex64,
) {
    for (part, value) in [push.re, push.im].into_iter().enumerate() {
        match age.checked_sub(1) {
            None => inputs[(row + part, kind)] += value,
            Some(place) => free[(row + part, pipe + 2 * place + kind)] += value,
        }
    }
}

const FREQUENCIES: u32 = 400;
const LOWEST_FREQUENCY: f64 = 1e-3;
const BISECTIONS: u32 = 40;
/// Step of the scan over delays, as a share of a period.
const SCAN_STEP: f64 = 0.05;

#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, JsonSchema)]
pub struct Margins {
    /// Factor by which the gain may rise. Below 1 the gain must fall. `None` if it has no limit.
    #[serde(rename = "gain_margin")]
    pub gain: Option<f64>,
    /// Phase margin at |L| = 1. `None` if |L| is never 1.
    #[serde(rename = "phase_margin_deg")]
    pub phase_deg: Option<f64>,
    /// Additional delay until the loop is unstable; 0 or less if it is unstable already. `None` if
    /// it is stable in the whole search range.
    #[serde(rename = "delay_margin_ms")]
    pub delay_ms: Option<f64>,
}

impl ClosedLoop {
    /// The smaller margin of both loops, each with the other loop closed. `delay_ms` is the result of
    /// a search over delays.
    pub fn margins(&self, delay_ms: Option<f64>) -> Margins {
        let [drive, frequency] = [0, 1].map(|kind| self.loop_margins(kind));
        let smaller = |one: Option<f64>, other: Option<f64>| one.into_iter().chain(other).reduce(f64::min);
        Margins {
            gain: smaller(drive.gain, frequency.gain),
            phase_deg: smaller(drive.phase_deg, frequency.phase_deg),
            delay_ms,
        }
    }

    /// Gain and phase margin of the drive loop (`kind` 0) or the frequency loop (1) while the other
    /// loop is closed. These loops are stable at small gain. A rising gain first meets the outermost
    /// crossing of the negative real axis, or L at half the sampling frequency.
    pub fn loop_margins(&self, kind: usize) -> Margins {
        let mut margins = Margins::default();
        let smaller = |known: Option<f64>, new: f64| Some(known.map_or(new, |known| known.min(new)));
        let Some(open) = self.open_loop_transfer(kind) else { return margins };
        let at = |theta: f64| open(Complex64::from_polar(1.0, theta));
        for &[low, high] in frequency_grid().array_windows() {
            let (Some(before), Some(after)) = (at(low), at(high)) else { continue };
            if before.im * after.im < 0.0
                && let Some(crossing) = at(root(low, high, |theta| at(theta).map(|l| l.im)))
                && crossing.re < 0.0
            {
                margins.gain = smaller(margins.gain, 1.0 / crossing.norm());
            }
            if (before.norm() - 1.0) * (after.norm() - 1.0) < 0.0
                && let Some(crossing) = at(root(low, high, |theta| at(theta).map(|l| l.norm() - 1.0)))
            {
                margins.phase_deg = smaller(margins.phase_deg, (-crossing).arg().to_degrees());
            }
        }
        if let Some(end) = at(PI)
            && end.re < 0.0
        {
            margins.gain = smaller(margins.gain, 1.0 / end.norm());
        }
        margins
    }
}

/// Rising frequencies, rad per period, up to just below half the sampling frequency.
fn frequency_grid() -> Vec<f64> {
    let last = PI * (1.0 - 1e-9);
    let ratio = (last / LOWEST_FREQUENCY).ln();
    (0..=FREQUENCIES).map(|n| LOWEST_FREQUENCY * (ratio * f64::from(n) / f64::from(FREQUENCIES)).exp()).collect()
}

fn root(low: f64, high: f64, value: impl Fn(f64) -> Option<f64>) -> f64 {
    let sign = |at: f64| value(at).unwrap_or(0.0).signum();
    let first = sign(low);
    let [low, high] = bisect([low, high], BISECTIONS, |at| sign(at) == first);
    f64::midpoint(low, high)
}

/// First delay, up to `longest` s, at which the spectral radius reaches 1.
pub fn delay_boundary(
    plant: &LinearPlant,
    controller: &LinearController,
    period: f64,
    longest: f64,
) -> Result<DelayBoundary, LoopError> {
    let stable = |delay: f64| {
        ClosedLoop::new(plant.clone(), *controller, LoopTiming { period, delay })?.spectral_radius().map(|r| r < 1.0)
    };
    if !stable(0.0)? {
        return Ok(DelayBoundary::Unstable);
    }
    let steps = (longest / (SCAN_STEP * period)).ceil() as u32;
    let mut low = 0.0;
    for step in 1..=steps {
        let high = (f64::from(step) * SCAN_STEP * period).min(longest);
        if !stable(high)? {
            return Ok(DelayBoundary::At(try_bisect([low, high], BISECTIONS, stable)?[0]));
        }
        low = high;
    }
    Ok(DelayBoundary::Beyond(longest))
}

const POINTS_PER_PERIOD: u32 = 40;
const BAND: f64 = 0.05;
/// |W| above this many setpoints counts as divergence.
const DIVERGENCE_LIMIT: f64 = 1e3;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepResponse {
    /// 5 % settling time, s. `None` if the response is outside the band at its end.
    pub settling: Option<f64>,
    /// Overshoot as a share of the step.
    pub overshoot: f64,
    pub peak_drive: f64,
    /// Number of periods at the drive limit. It is 0 in the linear loop, which has no limits.
    pub saturated_periods: u32,
    pub diverged: bool,
}

impl ClosedLoop {
    /// Steps the setpoint from rest to `setpoint` µm without limits. The response is W's component
    /// along the phase of the steady state. It is exact at resonance. Off resonance it is the
    /// scaled response to a small step.
    pub fn step_response(&self, setpoint: f64, periods: u32) -> StepResponse {
        let [direct, integral] = self.controller.matrices();
        let along = self.output_direction();
        // A higher setpoint acts like a negative deviation of W.
        let setpoint_deviation = -Vector2::from(along) * setpoint;
        let (whole, rest) = self.timing.split_delay();
        let mut states = vec![Complex64::ZERO; self.plant.poles().len()];
        let mut commands: VecDeque<Vector2<f64>> = vec![Vector2::zeros(); whole + 2].into();
        let mut integrals = Vector2::zeros();
        let mut response = StepResponse::default();
        let (mut before, mut entered) = (0.0_f64, None);
        for period in 0..periods {
            let w: Complex64 = states.iter().sum();
            let deviation = Vector2::new(w.re, w.im) + setpoint_deviation;
            let mut command: Vector2<f64> = direct * deviation + integrals;
            command.x += self.controller.feedforward * setpoint;
            integrals += integral * deviation;
            response.peak_drive = response.peak_drive.max(command.x);
            commands.push_front(command);
            commands.truncate(whole + 2);
            let [late, now] = [whole + 1, whole].map(|age| commands.get(age).copied().unwrap_or_default());
            for (command, span, from) in [(late, rest, 0.0), (now, self.timing.period - rest, rest)] {
                let start = states.clone();
                for point in 1..=POINTS_PER_PERIOD {
                    let seconds = span * f64::from(point) / f64::from(POINTS_PER_PERIOD);
                    if seconds == 0.0 {
                        continue;
                    }
                    for ((state, start), pole) in states.iter_mut().zip(&start).zip(self.plant.poles()) {
                        let [drive, frequency] = pole.input_effects(seconds);
                        *state = pole.transition(seconds) * start + drive * command.x + frequency * command.y;
                    }
                    let w: Complex64 = states.iter().sum();
                    let share = (w.re * along[0] + w.im * along[1]) / setpoint;
                    response.overshoot = response.overshoot.max(share - 1.0);
                    let (was, is) = ((before - 1.0).abs() <= BAND, (share - 1.0).abs() <= BAND);
                    if is && !was {
                        let edge = if before < 1.0 { 1.0 - BAND } else { 1.0 + BAND };
                        let part = ((edge - before) / (share - before)).clamp(0.0, 1.0);
                        let step = span / f64::from(POINTS_PER_PERIOD);
                        entered = Some(f64::from(period) * self.timing.period + from + seconds - step * (1.0 - part));
                    } else if !is {
                        entered = None;
                    }
                    before = share;
                }
            }
            if !before.is_finite() || before.abs() > DIVERGENCE_LIMIT {
                return StepResponse { settling: None, diverged: true, ..response };
            }
        }
        StepResponse { settling: entered, ..response }
    }

    fn output_direction(&self) -> [f64; 2] {
        let at = self.plant.at();
        let size = at.norm();
        if size > 0.0 { [at.re / size, at.im / size] } else { [1.0, 0.0] }
    }
}
