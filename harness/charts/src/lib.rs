//! Draws charts of cost and error of methods, models and laws, as page blocks and files. Running
//! scenarios does not need this crate.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod bench;
pub mod ladder;
pub mod laws;
mod loglog;
mod measured_run;
pub mod precision;
pub mod scenes;

pub use laws::{LawScenario, load_law_scenarios};
pub use measured_run::ChartError;

/// Compares general integration methods on the plate's equations.
pub mod integration {
    mod crossings;
    pub mod failure;
    pub mod fixed;
    pub mod method;
    pub mod problem;
    pub mod replay;
    pub mod sweep;

    pub use failure::MethodFailure;
    pub use fixed::FixedStepMethod;
    pub use method::{AdaptiveMethod, IntegrationMethod};
    pub use problem::Problem;
    pub use replay::{EquationForm, MethodReplay, MethodResult, ReplaySpec};
    pub use sweep::{Solver, SolverStatus, SweepConfig, SweepResult, sweep};
}
