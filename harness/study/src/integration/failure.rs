//! Defines why a method has no result.

/// Of an adaptive method, per interval. More steps count as a failure.
pub(crate) const MAX_STEPS: u32 = 100_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MethodFailure {
    /// A component is not finite or beyond a metre.
    #[error("diverged")]
    Diverged,
    #[error("unsupported form of problem")]
    UnsupportedProblem,
    #[error("singular linear system")]
    Singular,
    #[error("{0}")]
    CrateError(&'static str),
}
