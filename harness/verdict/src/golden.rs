//! Compares trials with accepted responses.

mod file;
mod learn;
mod thin;
mod tubes;

pub use file::{Baseline, BaselineBuild, BaselineError, LearningParameters, ResponseFeatures};
pub use learn::LearnError;
pub use tubes::{GoldenTubes, TubeComparison, TubeMatch, gap_between_rows, row_step_ms};

#[cfg(test)]
mod tests;
