//! Scenarios: what is played to a controller and what is expected of it.
//!
//! * [`raw`]: the file as serde reads it; every key it may have.
//! * [`mod@load`]: raw to [`Scenario`], which cannot hold a wrong value; every rule that a file can break.
//! * [`diagnostic`]: where a file is wrong and what was expected.
//! * [`expect`]: metrics, limits, expectations.
//! * [`fault`]: what goes wrong on the line, on purpose.
//! * [`variation`]: what differs from trial to trial.
//! * [`model`]: which tier of the plate it is played on.
//! * [`mod@find`]: which files a command line means.
//!
//! Nothing is run and nothing is judged here.

pub mod diagnostic;
pub mod expect;
pub mod fault;
pub mod find;
pub mod load;
pub mod model;
pub mod raw;
mod scenario;
pub mod variation;

pub use diagnostic::Diagnostic;
pub use expect::{Expectation, Limit, Metric, Over, Window};
pub use fault::{Direction, Fault, FaultKind};
pub use find::{Found, find};
pub use load::load;
pub use model::Model;
pub use scenario::{Controller, Gains, Input, Scenario, Trials};
pub use variation::{Spread, Variation};
