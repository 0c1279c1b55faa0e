//! The loop in the z plane: plant, commands on their way, integrals, one real matrix per period.
//!
//! A command that is computed at k acts from `kTs + delay`. With `delay = m Ts + r` the plate feels u(k−m−1) for the first `r` of a period and u(k−m) for
//! the rest; commands that have not acted yet, or not to the end, are part of the state. The state is `[re, im of each pole | u(k−1), u(k−2) … | integrals]`,
//! u = (drive, frequency).

use crate::controller::Controller;
use crate::plant::Plant;
use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{DMatrix, Schur};
use platebench_plate::Complex64;

/// Iterations of the eigenvalue solver per state; it needs two or three.
const ITERATIONS_PER_STATE: usize = 100;

/// When a controller samples and when its command acts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Timing {
    /// Control period Ts, s, above 0.
    pub period: f64,
    /// Sampling to actuation, s, 0 or more; more than a period is fine.
    pub delay: f64,
}

impl Timing {
    /// Whole periods of the delay, and the rest in s.
    pub(crate) fn split(&self) -> (usize, f64) {
        let whole = (self.delay / self.period).floor();
        let rest = self.delay - whole * self.period;
        // What rounding leaves of a whole number is none.
        if rest < 1e-9 * self.period {
            (whole as usize, 0.0)
        } else if rest > (1.0 - 1e-9) * self.period {
            (whole as usize + 1, 0.0)
        } else {
            (whole as usize, rest)
        }
    }
}

/// Why a loop cannot be analysed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AnalysisError {
    /// A gain, pole or time is not finite, or a period not above 0.
    #[error("a number of the loop is not finite or its period not above 0")]
    NotFinite,
    /// The eigenvalues were not found.
    #[error("the poles of the loop were not found")]
    NoConvergence,
}

/// A closed loop.
#[derive(Debug, Clone)]
pub struct ClosedLoop {
    pub(crate) plant: Plant,
    pub(crate) controller: Controller,
    pub(crate) timing: Timing,
    /// One period without any new command.
    free: DMatrix<f64>,
    /// What a command of either kind adds to the next state.
    inputs: DMatrix<f64>,
    /// The commands that a state leads to.
    outputs: DMatrix<f64>,
}

impl ClosedLoop {
    /// The loop of `controller` around `plant`.
    ///
    /// # Errors
    /// [`AnalysisError::NotFinite`].
    pub fn new(plant: Plant, controller: Controller, timing: Timing) -> Result<Self, AnalysisError> {
        let usable = timing.period > 0.0 && timing.delay >= 0.0 && (timing.delay / timing.period).is_finite();
        if !usable {
            return Err(AnalysisError::NotFinite);
        }
        let (whole, rest) = timing.split();
        let on_the_way = whole + usize::from(rest > 0.0);
        let poles = plant.poles().len();
        let (pipe, integrals) = (2 * poles, 2 * poles + 2 * on_the_way);
        let size = integrals + 2;
        let mut free = DMatrix::zeros(size, size);
        let mut inputs = DMatrix::zeros(size, 2);
        let mut outputs = DMatrix::zeros(2, size);
        let [direct, integral] = controller.matrices();
        for (n, pole) in plant.poles().iter().enumerate() {
            let Complex64 { re, im } = pole.growth(timing.period);
            let (row, late) = (2 * n, pole.growth(timing.period - rest));
            free.view_mut((row, row), (2, 2)).copy_from_slice(&[re, im, -im, re]);
            let recent = pole.pushes(timing.period - rest);
            for (kind, push) in recent.into_iter().enumerate() {
                add(&mut free, &mut inputs, row, (whole, pipe, kind), push);
            }
            if rest > 0.0 {
                for (kind, push) in pole.pushes(rest).into_iter().enumerate() {
                    add(&mut free, &mut inputs, row, (whole + 1, pipe, kind), late * push);
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
            // A loop that is not there has no integral that would stand at 1.
            let closed = f64::from(u8::from(controller.closes()[kind]));
            free[(integrals + kind, integrals + kind)] = closed;
            outputs[(kind, integrals + kind)] = closed;
        }
        let all = free.iter().chain(inputs.iter()).chain(outputs.iter());
        if all.into_iter().all(|value| value.is_finite()) {
            Ok(Self { plant, controller, timing, free, inputs, outputs })
        } else {
            Err(AnalysisError::NotFinite)
        }
    }

    /// The matrix of one period.
    pub fn matrix(&self) -> DMatrix<f64> {
        &self.free + &self.inputs * &self.outputs
    }

    /// The poles of the closed loop in the z plane. Those of commands on their way lie at or near 0.
    ///
    /// # Errors
    /// [`AnalysisError::NoConvergence`].
    pub fn poles(&self) -> Result<Vec<Complex64>, AnalysisError> {
        let matrix = self.matrix();
        let mut balanced = matrix.clone();
        balance_parlett_reinsch(&mut balanced);
        let limit = ITERATIONS_PER_STATE * matrix.nrows();
        // The solver's shifts run in circles for a few matrices; the transpose has the same eigenvalues and another way there.
        let forms = [balanced.clone(), balanced.transpose(), matrix.clone(), matrix.transpose()];
        let schur = forms.into_iter().find_map(|form| Schur::try_new(form, f64::EPSILON, limit));
        Ok(schur.ok_or(AnalysisError::NoConvergence)?.complex_eigenvalues().iter().copied().collect())
    }

    /// The largest distance of a pole from 0: below 1 the loop is stable.
    ///
    /// # Errors
    /// [`AnalysisError::NoConvergence`].
    pub fn spectral_radius(&self) -> Result<f64, AnalysisError> {
        Ok(self.poles()?.iter().fold(0.0, |largest, pole| pole.norm().max(largest)))
    }

    /// The loop transfer function L(z) of the drive (0) or the frequency (1), the other loop closed; the closed loop's poles are where `L = −1`. `None` where
    /// there is no such loop, or at a pole of L.
    pub(crate) fn opened(&self, kind: usize) -> Option<impl Fn(Complex64) -> Option<Complex64>> {
        self.controller.closes().get(kind).copied().filter(|closes| *closes)?;
        let other = 1 - kind;
        let matrix = &self.free + self.inputs.column(other) * self.outputs.row(other);
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

/// Adds what the command of `age` periods does to the pole at `row`.
fn add(
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
