//! Compares general integration methods on the plate's equations.

pub mod adaptive;
pub mod method;
pub mod replay;
pub mod sweep;

pub use adaptive::AdaptiveMethod;
pub use method::IntegrationMethod;
pub use replay::{EquationForm, Replay, ReplayResult, ReplaySpec};
pub use sweep::{Solver, SolverStatus, SweepConfig, SweepResult, sweep};
