//! Scenarios: what is played to a controller and what is expected of it.
//!
//! * [`raw`]: the file as serde reads it; every key it may have.
//! * [`mod@load`]: raw to [`Scenario`], which cannot hold a wrong value; every rule that a file can break.
//! * [`mod@schema`]: the same as JSON Schema, for editors.
//! * [`diagnostic`]: where a file is wrong and what was expected.
//! * [`expect`]: metrics, limits, expectations.
//! * [`fault`]: what goes wrong on the line, on purpose.
//! * [`variation`]: what differs from trial to trial.
//! * [`mod@find`]: which files a command line means.
//!
//! Nothing is run and nothing is judged here.

pub mod diagnostic;
pub mod expect;
pub mod fault;
pub mod find;
pub mod load;
mod parse;
pub mod raw;
mod scenario;
pub mod schema;
mod unjudged;
pub mod variation;
mod window;

pub use diagnostic::{Diagnostic, suggestion};
pub use expect::{Aggregation, Expectation, Limit, Metric};
pub use fault::{Direction, Fault, FaultKind};
pub use find::{FoundScenarios, find, list_files};
pub use load::{load, load_copies, load_with_diagnostics};
pub use parse::parse;
pub use platebench_plate::input;
pub use scenario::{AUTO_MODEL, Controller, Gains, InputFile, Scenario, Trials};
pub use unjudged::unjudged_changes;
pub use variation::{Spread, Variation};
pub use window::{ChangingProfile, Window};
