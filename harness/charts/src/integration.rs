//! Compares general integration methods on the plate's equations.

pub mod adaptive;
pub mod failure;
pub mod fixed;
pub mod method;
pub mod problem;
pub mod replay;
pub mod sweep;

pub use adaptive::AdaptiveMethod;
pub use failure::MethodFailure;
pub use fixed::FixedStepMethod;
pub use method::IntegrationMethod;
pub use problem::Problem;
pub use replay::{EquationForm, Replay, ReplayResult, ReplaySpec};
pub use sweep::{Solver, SolverStatus, SweepConfig, SweepResult, sweep};
