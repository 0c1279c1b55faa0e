//! Tunes gains for a plate: equation 24 in its readings, behaviour, feasibility, alternatives.
//! Field names carry their units because they are those of the JSON.

pub mod design;
pub mod evaluation;
pub mod format;
pub mod search;
pub mod spread;
pub mod transient;
pub mod tune;
pub mod verification;

pub use evaluation::{DesignEvaluation, evaluate_design};
pub use tune::{InfeasibilityCause, TuningResult, tune};
