//! Integrates the plate's equations with general methods, for charts and their tests only.

pub mod adaptive;
pub mod failure;
pub mod fixed;
pub mod method;
pub mod problem;
pub mod replay;
pub mod stability;
pub mod sweep;

pub use adaptive::AdaptiveMethod;
pub use failure::MethodFailure;
pub use fixed::FixedStepMethod;
pub use method::IntegrationMethod;
pub use problem::Problem;
pub use replay::{EquationForm, Replay, ReplayResult, ReplaySpec};
pub use stability::{StepLimit, StepLimitRow};
pub use sweep::{Solver, SolverStatus, SweepConfig, SweepResult, sweep};
