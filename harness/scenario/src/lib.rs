//! Scenarios: what is played to a controller and what is expected of it.
//!
//! * [`raw`]: the file as serde reads it; every key it may have.
//! * [`mod@load`]: raw to [`Scenario`], which cannot hold a wrong value; every rule that a file can break.
//! * [`mod@schema`]: the same as JSON Schema, for editors.
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
mod parse;
pub mod raw;
mod scenario;
pub mod schema;
pub mod variation;

pub use diagnostic::{Diagnostic, suggestion};
pub use expect::{Expectation, Limit, Metric, Over, Window};
pub use fault::{Direction, Fault, FaultKind};
pub use find::{Found, every_file, find};
pub use load::{examine, load, load_copies};
pub use model::Model;
pub use parse::parse;
pub use platebench_plate::input;
pub use scenario::{Controller, Gains, Input, Scenario, Trials};
pub use variation::{Spread, Variation};
