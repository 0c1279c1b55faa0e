//! Implements the textbook methods with a fixed step.

use crate::integration::failure::MethodFailure;
use crate::integration::problem::Problem;
use std::array::from_fn;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FixedStepMethod {
    /// Explicit Euler, order 1.
    Euler,
    /// The classical Runge-Kutta method, order 4.
    RungeKutta4,
    /// The implicit midpoint rule, order 2; solves its linear system once per interval, or per step
    /// if the matrix varies.
    Midpoint,
    /// Störmer's and Verlet's leapfrog, order 2; only for problems of second order.
    Verlet,
}

impl FixedStepMethod {
    pub const ALL: [Self; 4] = [Self::Euler, Self::RungeKutta4, Self::Midpoint, Self::Verlet];

    pub const fn order(self) -> u32 {
        match self {
            Self::Euler => 1,
            Self::RungeKutta4 => 4,
            Self::Midpoint | Self::Verlet => 2,
        }
    }

    pub fn advance<const N: usize, P: Problem<N>>(
        self,
        problem: &P,
        mut x: [f64; N],
        seconds: f64,
        steps: u32,
    ) -> Result<[f64; N], MethodFailure> {
        let step = seconds / f64::from(steps.max(1));
        match self {
            Self::Euler => (0..steps).for_each(|_| x = add_scaled(&x, step, &problem.rate(&x))),
            Self::RungeKutta4 => (0..steps).for_each(|_| x = runge_kutta_4(problem, &x, step)),
            Self::Midpoint => {
                let mut known = problem.matrix(&x);
                let mut inverse = resolvent(&known, 0.5 * step).ok_or(MethodFailure::Singular)?;
                for _ in 0..steps {
                    let mut middle = x;
                    if let Some(clock) = P::CLOCK.and_then(|clock| middle.get_mut(clock)) {
                        *clock += 0.5 * step;
                        let matrix = problem.matrix(&middle);
                        if matrix != known {
                            known = matrix;
                            inverse = resolvent(&known, 0.5 * step).ok_or(MethodFailure::Singular)?;
                        }
                    }
                    x = add_scaled(&x, step, &multiply(&inverse, &problem.rate(&middle)));
                }
            }
            Self::Verlet => {
                for _ in 0..steps {
                    x = problem.leapfrog(&x, step).ok_or(MethodFailure::UnsupportedProblem)?;
                }
            }
        }
        Ok(x)
    }
}

#[inline]
fn add_scaled<const N: usize>(x: &[f64; N], step: f64, rate: &[f64; N]) -> [f64; N] {
    from_fn(|i| x[i] + step * rate[i])
}

#[inline]
fn runge_kutta_4<const N: usize, P: Problem<N>>(problem: &P, x: &[f64; N], step: f64) -> [f64; N] {
    let first = problem.rate(x);
    let second = problem.rate(&add_scaled(x, 0.5 * step, &first));
    let third = problem.rate(&add_scaled(x, 0.5 * step, &second));
    let fourth = problem.rate(&add_scaled(x, step, &third));
    from_fn(|i| x[i] + step / 6.0 * (first[i] + 2.0 * (second[i] + third[i]) + fourth[i]))
}

#[inline]
fn multiply<const N: usize>(matrix: &[[f64; N]; N], x: &[f64; N]) -> [f64; N] {
    from_fn(|row| (0..N).map(|column| matrix[row][column] * x[column]).sum())
}

/// `(I − half·A)⁻¹` by Gauss and Jordan with partial pivoting; `None` if singular.
fn resolvent<const N: usize>(matrix: &[[f64; N]; N], half: f64) -> Option<[[f64; N]; N]> {
    let unit = |row: usize, column: usize| if row == column { 1.0 } else { 0.0 };
    let mut left: [[f64; N]; N] = from_fn(|row| from_fn(|column| unit(row, column) - half * matrix[row][column]));
    let mut right: [[f64; N]; N] = from_fn(|row| from_fn(|column| unit(row, column)));
    for pivot in 0..N {
        let largest = (pivot..N).max_by(|a, b| left[*a][pivot].abs().total_cmp(&left[*b][pivot].abs()))?;
        left.swap(pivot, largest);
        right.swap(pivot, largest);
        let scale = left[pivot][pivot];
        if scale == 0.0 || !scale.is_finite() {
            return None;
        }
        left[pivot] = left[pivot].map(|value| value / scale);
        right[pivot] = right[pivot].map(|value| value / scale);
        let (from_left, from_right) = (left[pivot], right[pivot]);
        for row in (0..N).filter(|row| *row != pivot) {
            let share = left[row][pivot];
            left[row] = from_fn(|column| left[row][column] - share * from_left[column]);
            right[row] = from_fn(|column| right[row][column] - share * from_right[column]);
        }
    }
    Some(right)
}
