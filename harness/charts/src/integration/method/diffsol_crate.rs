//! Adapts `diffsol`, with its dense matrices of nalgebra.

use crate::integration::failure::{MAX_STEPS, MethodFailure};
use crate::integration::problem::Problem;
use diffsol::error::{DiffsolError, OdeSolverError};
use diffsol::{
    NalgebraContext, NalgebraLU, NalgebraMat, NalgebraVec, OdeBuilder, OdeEquations, OdeEquationsImplicit,
    OdeSolverMethod, OdeSolverProblem, OdeSolverStopReason, Vector,
};

type LinearSolver = NalgebraLU<f64>;

pub(super) fn bdf<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<[f64; N], MethodFailure> {
    let equations = build(problem, x, seconds, tolerance)?;
    advance(equations.bdf::<LinearSolver>(), seconds)
}

pub(super) fn esdirk34<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<[f64; N], MethodFailure> {
    let equations = build(problem, x, seconds, tolerance)?;
    advance(equations.esdirk34::<LinearSolver>(), seconds)
}

pub(super) fn tsit45<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<[f64; N], MethodFailure> {
    let equations = build(problem, x, seconds, tolerance)?;
    advance(equations.tsit45(), seconds)
}

fn build<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<
    OdeSolverProblem<
        impl OdeEquationsImplicit<T = f64, V = NalgebraVec<f64>, M = NalgebraMat<f64>, C = NalgebraContext>,
    >,
    MethodFailure,
> {
    let equations = OdeBuilder::<NalgebraMat<f64>>::new()
        .rtol(tolerance)
        .atol([tolerance])
        .h0(seconds)
        .rhs_implicit(
            |x, _, _, rate| rate.copy_from_slice(&problem.rate(&state(x))),
            |x, _, _, direction, product| {
                for (entry, row) in product.iter_mut().zip(problem.matrix(&state(x))) {
                    *entry = row.iter().zip(direction).map(|(factor, component)| factor * component).sum();
                }
            },
        )
        .init(move |_, _, start| start.copy_from_slice(&x), N)
        .build()?;
    Ok(equations)
}

/// Returns NaN if the number of components is wrong. The caller then reports a divergence.
fn state<const N: usize>(components: &[f64]) -> [f64; N] {
    components.try_into().unwrap_or([f64::NAN; N])
}

fn advance<'a, const N: usize, E, S>(solver: Result<S, DiffsolError>, seconds: f64) -> Result<[f64; N], MethodFailure>
where
    E: OdeEquations<T = f64, V = NalgebraVec<f64>> + 'a,
    S: OdeSolverMethod<'a, E>,
{
    let mut solver = solver?;
    solver.set_stop_time(seconds)?;
    for _ in 0..MAX_STEPS {
        if solver.step()? == OdeSolverStopReason::TstopReached {
            return Ok(state(&solver.state().y.clone_as_vec()));
        }
    }
    Err(MethodFailure::CrateError("too many steps"))
}

impl From<DiffsolError> for MethodFailure {
    fn from(error: DiffsolError) -> Self {
        Self::CrateError(match error {
            DiffsolError::OdeSolverError(OdeSolverError::StepSizeTooSmall { .. }) => "step too small",
            DiffsolError::OdeSolverError(OdeSolverError::TooManyErrorTestFailures { .. }) => "too many rejected steps",
            DiffsolError::OdeSolverError(OdeSolverError::TooManyNonlinearSolverFailures { .. }) => {
                "Newton did not converge"
            }
            _ => "internal error of the crate",
        })
    }
}
