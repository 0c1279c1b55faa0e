//! Adapts crates with adaptive methods. The feature `diffsol` adds a crate that takes long to
//! build.

mod differential_equations_crate;
#[cfg(feature = "diffsol")]
mod diffsol_crate;

use crate::integration::failure::{MAX_STEPS, MethodFailure};
use crate::integration::problem::Problem;
use ode_solvers::dop_shared::IntegrationError;
use ode_solvers::{Dop853, Dopri5, OutputType, SVector, System};

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
