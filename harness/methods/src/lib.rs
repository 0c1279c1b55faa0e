//! General integration methods on the plate's equations, for comparison with its exact propagation.
//!
//! * [`problem`]: the equations of the envelope, of the mode and of the carrier, as vectors and their rates.
//! * [`fixed`]: explicit Euler, classical Runge-Kutta, implicit midpoint, Störmer-Verlet.
//! * [`adaptive`]: the published crates `ode_solvers` and `differential-equations`.
//! * [`method`]: all of them under one face.
//! * [`replay`]: a stretch of a trial with its drives, played again through any of them.
//! * [`mod@sweep`]: work against precision.
//! * [`stability`]: the largest stable step of each, measured beside what theory says.
//!
//! The bench never runs them: nothing but charts and their tests may import this crate.

pub mod adaptive;
pub mod fixed;
pub mod method;
pub mod problem;
pub mod replay;
pub mod stability;
pub mod sweep;

pub use adaptive::Adaptive;
pub use fixed::Fixed;
pub use method::{Failure, Method};
pub use problem::Problem;
pub use replay::{Course, Frame, Outcome, Passage};
pub use stability::{Limit, LimitRow};
pub use sweep::{Contender, Effort, Measured, Status, sweep};
