//! Tunes gains by equation 24 of the paper, evaluates them, and finds why a target is infeasible.

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
