//! Every method under one face.

use crate::adaptive::Adaptive;
use crate::fixed::Fixed;
use crate::problem::Problem;

/// Beyond this a component has left every scale that a plate knows, µm.
const GONE: f64 = 1e6;

/// Why a method has no result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Failure {
    /// A component is not finite or beyond a metre.
    #[error("diverged")]
    Diverged,
    /// The method is made for problems of another form.
    #[error("not a problem of its form")]
    NotItsForm,
    /// The linear system of an implicit step has no solution.
    #[error("its linear system is singular")]
    Singular,
    /// The crate gave up.
    #[error("{0}")]
    GaveUp(&'static str),
}

/// A general method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// Of a fixed step.
    Fixed(Fixed),
    /// Of a published crate, with a tolerance.
    Adaptive(Adaptive),
}

impl Method {
    /// Every method.
    pub fn all() -> impl Iterator<Item = Self> {
        Fixed::ALL.map(Self::Fixed).into_iter().chain(Adaptive::ALL.map(Self::Adaptive))
    }

    /// Its name in tables and legends.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fixed(Fixed::Euler) => "explicit Euler",
            Self::Fixed(Fixed::RungeKutta4) => "RK4",
            Self::Fixed(Fixed::Midpoint) => "implicit midpoint",
            Self::Fixed(Fixed::Verlet) => "Störmer-Verlet",
            Self::Adaptive(Adaptive::Dopri5) => "ode_solvers DOPRI5",
            Self::Adaptive(Adaptive::Dop853) => "ode_solvers DOP853",
            Self::Adaptive(Adaptive::DeDop853) => "differential-equations DOP853",
            Self::Adaptive(Adaptive::DeVerner98) => "differential-equations RKV98",
        }
    }

    /// True where it is of a published crate and not ours.
    pub const fn is_published(self) -> bool {
        match self {
            Self::Fixed(_) => false,
            Self::Adaptive(_) => true,
        }
    }

    /// The state after `seconds` of `problem`. `setting` is the longest step in s of a fixed method, which is shortened until a whole number of steps fits,
    /// and the tolerance, relative and in µm, of one that chooses its steps.
    ///
    /// # Errors
    /// [`Failure`] where there is no result.
    #[inline]
    pub fn advance<const N: usize, P: Problem<N>>(
        self,
        problem: &P,
        x: [f64; N],
        seconds: f64,
        setting: f64,
    ) -> Result<[f64; N], Failure> {
        let x = match self {
            Self::Fixed(method) => method.advance(problem, x, seconds, whole_steps(seconds, setting))?,
            Self::Adaptive(method) => method.advance(problem, x, seconds, setting)?,
        };
        if x.iter().all(|component| component.abs() < GONE) { Ok(x) } else { Err(Failure::Diverged) }
    }
}

/// How many equal steps of at most `step` make `seconds`; a share of 1e-9 too long is rounding.
fn whole_steps(seconds: f64, step: f64) -> u32 {
    (seconds / step - 1e-9).ceil().max(1.0) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_shortened_and_never_lengthened() {
        for (seconds, step, steps) in
            [(1e-3, 1e-3, 1), (1e-3, 1.01e-3, 1), (1e-3, 0.99e-3, 2), (1e-3, 1e-4, 10), (3e-3, 1e-3, 3), (1e-3, 1.0, 1)]
        {
            assert_eq!(whole_steps(seconds, step), steps, "{seconds} {step}");
        }
    }
}
