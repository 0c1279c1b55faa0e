//! Applies general integration methods to the plate's equations, for comparison with the exact
//! propagation.
//!
//! * [`problem`]: the equations of envelope, mode and carrier as vectors and their rates.
//! * [`fixed`]: explicit Euler, classical Runge-Kutta, implicit midpoint, Störmer-Verlet.
//! * [`adaptive`]: the published crates `ode_solvers` and `differential-equations`.
//! * [`method`]: one interface to all methods; [`failure`]: why one has no result.
//! * [`replay`]: a part of a trial with its drives, integrated by any method.
//! * [`mod@sweep`]: work against precision.
//! * [`stability`]: the largest stable step of each method, measured and from theory.
//!
//! Only charts and their tests use them.

pub mod adaptive;
pub mod failure;
pub mod fixed;
pub mod method;
pub mod problem;
pub mod replay;
pub mod stability;
pub(crate) mod step_limit_table;
pub mod sweep;

pub use adaptive::AdaptiveMethod;
pub use failure::MethodFailure;
pub use fixed::FixedStepMethod;
pub use method::IntegrationMethod;
pub use problem::Problem;
pub use replay::{EquationForm, Replay, ReplayResult, ReplaySpec};
pub use stability::{StepLimit, StepLimitRow};
pub use sweep::{Solver, SolverStatus, SweepConfig, SweepResult, sweep};
