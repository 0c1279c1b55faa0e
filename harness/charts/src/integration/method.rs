//! Provides one interface to all methods.

use crate::integration::adaptive::AdaptiveMethod;
use crate::integration::failure::MethodFailure;
use crate::integration::fixed::{FixedStepMethod, StepMatrix};
use crate::integration::problem::Problem;

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
