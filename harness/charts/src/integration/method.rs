//! Provides one interface to all integration methods, and adapts crates with adaptive methods.
//!
//! The feature `diffsol` adds a crate that takes long to build.

mod differential_equations_crate;
#[cfg(feature = "diffsol")]
mod diffsol_crate;

use crate::integration::failure::{MAX_STEPS, MethodFailure};
use crate::integration::fixed::{FixedStepMethod, StepMatrix};
use crate::integration::problem::Problem;
use ode_solvers::dop_shared::IntegrationError;
use ode_solvers::{Dop853, Dopri5, OutputType, SVector, System};

const DIVERGENCE_LIMIT_UM: f64 = 1e6;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum IntegrationMethod {
    Fixed(FixedStepMethod),
    Adaptive(AdaptiveMethod),
}

impl IntegrationMethod {
    pub fn all() -> impl Iterator<Item = Self> {
        let fixed = FixedStepMethod::ALL.iter().copied().map(Self::Fixed);
        fixed.chain(AdaptiveMethod::ALL.iter().copied().map(Self::Adaptive))
    }

    pub const fn name(self) -> &'static str {
        match self {
            Self::Fixed(method) => method.into_str(),
            Self::Adaptive(method) => method.into_str(),
        }
    }

    /// For a fixed step, `setting` is the longest step in s. It is reduced until whole steps fill
    /// the interval. For an adaptive method, `setting` is the relative tolerance and the absolute
    /// one in µm. [`FixedStepMethod::advance`] defines `kept`.
    #[inline]
    pub fn advance<const N: usize, P: Problem<N>>(
        self,
        problem: &P,
        x: [f64; N],
        seconds: f64,
        setting: f64,
        kept: &mut Option<StepMatrix<N>>,
    ) -> Result<[f64; N], MethodFailure> {
        let x = match self {
            Self::Fixed(method) => method.advance(problem, x, seconds, step_count(seconds, setting), kept)?,
            Self::Adaptive(method) => method.advance(problem, x, seconds, setting)?,
        };
        if x.iter().all(|component| component.abs() < DIVERGENCE_LIMIT_UM) {
            Ok(x)
        } else {
            Err(MethodFailure::Diverged)
        }
    }
}

/// An excess of up to 1e-9 steps is a rounding error and adds no step.
fn step_count(seconds: f64, step: f64) -> u32 {
    (seconds / step - 1e-9).ceil().max(1.0) as u32
}

/// Runs a solver of `ode_solvers`. It is a macro because the solvers have no common trait. The
/// constants are the crate's defaults. The output contains every step, because the error of the
/// dense output (version 0.6) does not depend on the tolerance.
macro_rules! integrate_sparse {
    ($solver:ident, $problem:expr, $x:expr, $seconds:expr, $tolerance:expr,
     $beta:expr, $smallest:expr, $largest:expr) => {{
        let mut solver = $solver::from_param(
            OdeSystem($problem),
            0.0,
            $seconds,
            $seconds,
            SVector::from($x),
            $tolerance,
            $tolerance,
            0.9,
            $beta,
            $smallest,
            $largest,
            $seconds,
            0.0,
            MAX_STEPS,
            MAX_STEPS,
            OutputType::Sparse,
        );
        solver.integrate().map_err(|error| crate_failure(&error))?;
        last_state(solver.y_out())
    }};
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str)]
pub enum AdaptiveMethod {
    #[strum(serialize = "ode_solvers DOPRI5")]
    Dopri5,
    #[strum(serialize = "ode_solvers DOP853")]
    Dop853,
    #[strum(serialize = "differential-equations DOP853")]
    DeDop853,
    /// Verner 9(8), "most efficient".
    #[strum(serialize = "differential-equations RKV98")]
    DeVerner98,
    /// Backward differentiation formulas of order 1 to 5.
    #[cfg(feature = "diffsol")]
    #[strum(serialize = "diffsol BDF")]
    DiffsolBdf,
    #[cfg(feature = "diffsol")]
    #[strum(serialize = "diffsol ESDIRK34")]
    DiffsolEsdirk34,
    #[cfg(feature = "diffsol")]
    #[strum(serialize = "diffsol TSIT45")]
    DiffsolTsit45,
}

impl AdaptiveMethod {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    /// `tolerance` is both the relative tolerance and the absolute tolerance in µm.
    pub fn advance<const N: usize, P: Problem<N>>(
        self,
        problem: &P,
        x: [f64; N],
        seconds: f64,
        tolerance: f64,
    ) -> Result<[f64; N], MethodFailure> {
        match self {
            Self::Dopri5 => integrate_sparse!(Dopri5, problem, x, seconds, tolerance, 0.04, 0.2, 10.0),
            Self::Dop853 => integrate_sparse!(Dop853, problem, x, seconds, tolerance, 0.0, 0.333, 6.0),
            Self::DeDop853 => differential_equations_crate::dop853(problem, x, seconds, tolerance),
            Self::DeVerner98 => differential_equations_crate::verner98(problem, x, seconds, tolerance),
            #[cfg(feature = "diffsol")]
            Self::DiffsolBdf => diffsol_crate::bdf(problem, x, seconds, tolerance),
            #[cfg(feature = "diffsol")]
            Self::DiffsolEsdirk34 => diffsol_crate::esdirk34(problem, x, seconds, tolerance),
            #[cfg(feature = "diffsol")]
            Self::DiffsolTsit45 => diffsol_crate::tsit45(problem, x, seconds, tolerance),
        }
    }
}

struct OdeSystem<'a, P>(&'a P);

impl<const N: usize, P: Problem<N>> System<f64, SVector<f64, N>> for OdeSystem<'_, P> {
    #[inline]
    fn system(&self, _: f64, x: &SVector<f64, N>, rate: &mut SVector<f64, N>) {
        *rate = SVector::from(self.0.rate(&x.data.0[0]));
    }
}

fn crate_failure(error: &IntegrationError) -> MethodFailure {
    MethodFailure::CrateError(match error {
        IntegrationError::MaxNumStepReached { .. } => "too many steps",
        IntegrationError::StepSizeUnderflow { .. } => "step too small",
        IntegrationError::StiffnessDetected { .. } => "problem classified as stiff",
    })
}

fn last_state<const N: usize>(states: &[SVector<f64, N>]) -> Result<[f64; N], MethodFailure> {
    states.last().map(|state| state.data.0[0]).ok_or(MethodFailure::CrateError("no result"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_shortened_and_never_lengthened() {
        for (seconds, step, steps) in
            [(1e-3, 1e-3, 1), (1e-3, 1.01e-3, 1), (1e-3, 0.99e-3, 2), (1e-3, 1e-4, 10), (3e-3, 1e-3, 3), (1e-3, 1.0, 1)]
        {
            assert_eq!(step_count(seconds, step), steps, "{seconds} {step}");
        }
    }
}
