//! Builds the closed loop in the z plane: plant, pending commands and integrals as one real matrix
//! per period.
//!
//! A command computed at k acts from `kTs + delay`. With `delay = m Ts + r`, u(k−m−1) acts for the
//! first `r` of a period, then u(k−m). The state is
//! `[re, im of each pole | u(k−1), u(k−2) … | integrals]`, u = (drive, frequency).

use crate::loops::controller::LinearController;
use crate::loops::plant::LinearPlant;
use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{DMatrix, Schur};
use platebench_plate::Complex64;

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
pub enum AnalysisError {
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
    pub fn new(plant: LinearPlant, controller: LinearController, timing: LoopTiming) -> Result<Self, AnalysisError> {
        let usable = timing.period > 0.0 && timing.delay >= 0.0 && (timing.delay / timing.period).is_finite();
        if !usable {
            return Err(AnalysisError::NotFinite);
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
            Err(AnalysisError::NotFinite)
        }
    }

    pub fn matrix(&self) -> DMatrix<f64> {
        &self.free_motion + &self.inputs * &self.outputs
    }

    /// Poles in the z plane. The poles of pending commands are at or near 0.
    pub fn poles(&self) -> Result<Vec<Complex64>, AnalysisError> {
        let matrix = self.matrix();
        let mut balanced = matrix.clone();
        balance_parlett_reinsch(&mut balanced);
        let limit = ITERATIONS_PER_STATE * matrix.nrows();
        // For a few matrices the solver does not converge. The transpose has the same eigenvalues.
        let forms = [balanced.clone(), balanced.transpose(), matrix.clone(), matrix.transpose()];
        let schur = forms.into_iter().find_map(|form| Schur::try_new(form, f64::EPSILON, limit));
        Ok(schur.ok_or(AnalysisError::NoConvergence)?.complex_eigenvalues().iter().copied().collect())
    }

    /// Largest magnitude of a pole. The loop is stable if this is below 1.
    pub fn spectral_radius(&self) -> Result<f64, AnalysisError> {
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
