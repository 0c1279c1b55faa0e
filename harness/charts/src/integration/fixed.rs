//! Implements the textbook methods with a fixed step.

use crate::integration::failure::MethodFailure;
use crate::integration::problem::{Problem, Split};
use std::array::from_fn;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str)]
pub enum FixedStepMethod {
    #[strum(serialize = "explicit Euler")]
    Euler,
    #[strum(serialize = "RK4")]
    RungeKutta4,
    /// Implicit midpoint rule. It solves its linear system per interval, or per step if A varies.
    #[strum(serialize = "implicit midpoint")]
    Midpoint,
    /// Gauss-Legendre collocation with two stages. Its step matrix is a Padé approximant of the
    /// exponential, computed once per interval (Hairer, Wanner: Solving ODEs II, IV.3).
    #[strum(serialize = "Gauss-Legendre 4")]
    Gauss4,
    #[strum(serialize = "Gauss-Legendre 6")]
    Gauss6,
    /// Matrix exponential by scaling and squaring, once per interval. Exact up to rounding.
    #[strum(serialize = "matrix exponential")]
    Exponential,
    /// Matrix exponential that reuses the previous step matrix if the equations are the same.
    #[strum(serialize = "matrix exponential, kept")]
    KeptExponential,
    /// Leapfrog method, only for problems of second order.
    #[strum(serialize = "Störmer-Verlet")]
    Verlet,
    /// Strang splitting: half a step of damping and drive, the exact undamped rotation, half a step
    /// of damping and drive.
    #[strum(serialize = "rotation splitting")]
    Splitting,
}

/// The step matrix of an interval, for [`FixedStepMethod::KeptExponential`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepMatrix<const N: usize> {
    /// A of `x' = Ax + b`, 1/s.
    matrix: [[f64; N]; N],
    /// Step h, s.
    step: f64,
    /// M of `x(h) = x + h M(hA) (Ax + b)`.
    increment: [[f64; N]; N],
}

impl FixedStepMethod {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    /// M of `x(h) = x + h M(hA) (Ax + b)`. `None` if it has no M or a singular denominator.
    fn increment<const N: usize>(self, matrix: &[[f64; N]; N], step: f64) -> Option<[[f64; N]; N]> {
        let z = scaled(matrix, step);
        match self {
            Self::Euler | Self::RungeKutta4 | Self::Verlet | Self::Splitting => None,
            Self::Midpoint => inverse(&polynomial(&z, [1.0, -0.5, 0.0, 0.0])),
            Self::Gauss4 => inverse(&polynomial(&z, [1.0, -1.0 / 2.0, 1.0 / 12.0, 0.0])),
            Self::Gauss6 => {
                let denominator = inverse(&polynomial(&z, [1.0, -1.0 / 2.0, 1.0 / 10.0, -1.0 / 120.0]))?;
                Some(product(&denominator, &polynomial(&z, [1.0, 0.0, 1.0 / 60.0, 0.0])))
            }
            Self::Exponential | Self::KeptExponential => {
                // Below a norm of 0.02, the approximant of order 6 is exact up to rounding.
                let largest = z.iter().map(|row| row.iter().map(|value| value.abs()).sum()).fold(0.0, f64::max);
                let doublings = (largest / 0.02_f64).log2().ceil().max(0.0) as i32;
                let share = 0.5_f64.powi(doublings);
                let mut phi = Self::Gauss6.increment(matrix, step * share)?;
                let mut y = scaled(&z, share);
                for _ in 0..doublings {
                    // φ(2y) = φ(y) (1 + e^y)/2, e^y = 1 + yφ(y)
                    let half = scaled(&product(&y, &phi), 0.5);
                    phi = product(&phi, &polynomial(&half, [1.0, 1.0, 0.0, 0.0]));
                    y = scaled(&y, 2.0);
                }
                Some(phi)
            }
        }
    }

    /// `kept` stores the step matrix of [`Self::KeptExponential`] from the previous interval.
    pub fn advance<const N: usize, P: Problem<N>>(
        self,
        problem: &P,
        mut x: [f64; N],
        seconds: f64,
        steps: u32,
        kept: &mut Option<StepMatrix<N>>,
    ) -> Result<[f64; N], MethodFailure> {
        let step = seconds / f64::from(steps.max(1));
        match self {
            Self::Euler => (0..steps).for_each(|_| x = add_scaled(&x, step, &problem.rate(&x))),
            Self::RungeKutta4 => (0..steps).for_each(|_| x = runge_kutta_4(problem, &x, step)),
            Self::Midpoint | Self::Gauss4 | Self::Gauss6 | Self::Exponential | Self::KeptExponential => {
                let mut known = problem.matrix(&x);
                let mut increment = match kept {
                    Some(before) if before.matrix == known && before.step == step => before.increment,
                    _ => self.increment(&known, step).ok_or(MethodFailure::Singular)?,
                };
                for _ in 0..steps {
                    let mut middle = x;
                    if let Some(clock) = P::CLOCK.and_then(|clock| middle.get_mut(clock)) {
                        *clock += 0.5 * step;
                        let matrix = problem.matrix(&middle);
                        if matrix != known {
                            known = matrix;
                            increment = self.increment(&known, step).ok_or(MethodFailure::Singular)?;
                        }
                    }
                    x = add_scaled(&x, step, &multiply(&increment, &problem.rate(&middle)));
                }
                if self == Self::KeptExponential {
                    *kept = Some(StepMatrix { matrix: known, step, increment });
                }
            }
            Self::Verlet => {
                for _ in 0..steps {
                    x = problem.leapfrog(&x, step).ok_or(MethodFailure::UnsupportedProblem)?;
                }
            }
            Self::Splitting => {
                let mut known = problem.matrix(&x);
                let mut parts = problem.split(&x, step);
                for _ in 0..steps {
                    let mut middle = x;
                    if let Some(clock) = P::CLOCK.and_then(|clock| middle.get_mut(clock)) {
                        *clock += 0.5 * step;
                        let matrix = problem.matrix(&middle);
                        if matrix != known {
                            known = matrix;
                            parts = problem.split(&middle, step);
                        }
                    }
                    x = split_step(problem, &parts, &x, step);
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
fn split_step<const N: usize, P: Problem<N>>(problem: &P, parts: &Split<N>, x: &[f64; N], step: f64) -> [f64; N] {
    let kick = |x: &[f64; N]| -> [f64; N] {
        let force = problem.forcing(x);
        from_fn(|i| parts.decay[i] * x[i] + parts.gain[i] * force[i])
    };
    let mut turned = multiply(&parts.rotation, &kick(x));
    if let Some(clock) = P::CLOCK {
        turned[clock] = x[clock] + step;
    }
    let mut after = kick(&turned);
    if let Some(clock) = P::CLOCK {
        after[clock] = turned[clock];
    }
    after
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

fn scaled<const N: usize>(matrix: &[[f64; N]; N], by: f64) -> [[f64; N]; N] {
    matrix.map(|row| row.map(|value| value * by))
}

fn product<const N: usize>(left: &[[f64; N]; N], right: &[[f64; N]; N]) -> [[f64; N]; N] {
    from_fn(|row| from_fn(|column| (0..N).map(|inner| left[row][inner] * right[inner][column]).sum()))
}

/// `c0 + c1 z + c2 z² + c3 z³`.
fn polynomial<const N: usize>(z: &[[f64; N]; N], coefficients: [f64; 4]) -> [[f64; N]; N] {
    let unit = |row: usize, column: usize| if row == column { 1.0 } else { 0.0 };
    coefficients.iter().rev().fold([[0.0; N]; N], |sum, coefficient| {
        let higher = product(&sum, z);
        from_fn(|row| from_fn(|column| higher[row][column] + coefficient * unit(row, column)))
    })
}

/// Gauss-Jordan elimination with partial pivoting. `None` if `matrix` is singular.
fn inverse<const N: usize>(matrix: &[[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut left = *matrix;
    let mut right = polynomial(&left, [1.0, 0.0, 0.0, 0.0]);
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
