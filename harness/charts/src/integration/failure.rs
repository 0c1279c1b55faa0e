//! Defines the failures of integration methods.

/// Largest number of steps of an adaptive method per interval of a replay.
pub const MAX_STEPS: u32 = 100_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MethodFailure {
    /// A component of the state is not finite or exceeds 1 m.
    #[error("diverged")]
    Diverged,
    #[error("unsupported form of problem")]
    UnsupportedProblem,
    #[error("singular linear system")]
    Singular,
    #[error("{0}")]
    CrateError(&'static str),
}
