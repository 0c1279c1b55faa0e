//! Defines why a method has no result.

/// Why a method has no result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MethodFailure {
    /// A component is not finite or beyond a metre.
    #[error("diverged")]
    Diverged,
    /// The method does not support this form of problem.
    #[error("unsupported form of problem")]
    UnsupportedProblem,
    /// The linear system of an implicit step has no solution.
    #[error("singular linear system")]
    Singular,
    /// The crate reports an error.
    #[error("{0}")]
    CrateError(&'static str),
}
