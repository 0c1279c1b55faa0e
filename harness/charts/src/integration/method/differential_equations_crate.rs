//! Adapts `differential-equations`.

use crate::integration::failure::{MAX_STEPS, MethodFailure};
use crate::integration::problem::Problem;
use differential_equations::control::ControlFlag;
use differential_equations::error::Error;
use differential_equations::interpolate::Interpolation;
use differential_equations::methods::ExplicitRungeKutta;
use differential_equations::ode::{ODE, OrdinaryNumericalMethod, solve_ode};
use differential_equations::solout::Solout;
use differential_equations::solution::Solution;

pub(super) fn dop853<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<[f64; N], MethodFailure> {
    let method = ExplicitRungeKutta::dop853().rtol(tolerance).atol(tolerance);
    solve(method.max_steps(MAX_STEPS as usize), problem, seconds, x)
}

pub(super) fn verner98<const N: usize, P: Problem<N>>(
    problem: &P,
    x: [f64; N],
    seconds: f64,
    tolerance: f64,
) -> Result<[f64; N], MethodFailure> {
    let method = ExplicitRungeKutta::rkv988e().rtol(tolerance).atol(tolerance);
    solve(method.max_steps(MAX_STEPS as usize), problem, seconds, x)
}

struct OdeSystem<'a, P>(&'a P);

impl<const N: usize, P: Problem<N>> ODE<f64, [f64; N]> for OdeSystem<'_, P> {
    #[inline]
    fn diff(&self, _: f64, x: &[f64; N], rate: &mut [f64; N]) {
        *rate = self.0.rate(x);
    }
}

struct NoStepOutput;

impl<const N: usize> Solout<f64, [f64; N]> for NoStepOutput {
    fn solout<I>(
        &mut self,
        _: f64,
        _: f64,
        _: &[f64; N],
        _: &[f64; N],
        _: &mut I,
        _: &mut Solution<f64, [f64; N]>,
    ) -> ControlFlag<f64, [f64; N]>
    where
        I: Interpolation<f64, [f64; N]> + ?Sized,
    {
        ControlFlag::Continue
    }
}

fn solve<const N: usize, P, M>(mut method: M, problem: &P, seconds: f64, x: [f64; N]) -> Result<[f64; N], MethodFailure>
where
    P: Problem<N>,
    M: OrdinaryNumericalMethod<f64, [f64; N]> + Interpolation<f64, [f64; N]>,
{
    match solve_ode(&mut method, &OdeSystem(problem), 0.0, seconds, &x, &mut NoStepOutput) {
        Ok(_) => Ok(*method.y()),
        Err(error) => Err(MethodFailure::CrateError(match error {
            Error::MaxSteps { .. } => "too many steps",
            Error::StepSize { .. } => "step too small",
            Error::Stiffness { .. } => "problem classified as stiff",
            Error::BadInput { .. } => "input rejected",
            Error::OutOfBounds { .. }
            | Error::NoLags
            | Error::InsufficientHistory { .. }
            | Error::LinearAlgebra { .. } => "internal error of the crate",
        })),
    }
}
