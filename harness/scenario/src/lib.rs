//! Reads and checks scenario files.
//!
//! * [`raw`]: the file as serde reads it, with every key.
//! * [`mod@load`]: raw to [`Scenario`], which is always valid.
//! * [`mod@schema`]: JSON Schemas for editors.
//! * [`diagnostic`]: an error with its position in a file.
//! * [`expect`]: metrics, limits, expectations.
//! * [`fault`]: planned faults of line and sensor.
//! * [`variation`]: the plate and sensor of a trial.
//! * [`mod@find`]: searches for scenario files.
//!
//! `platebench-runner` runs scenarios, and `platebench-verdict` judges them.

mod bounds;
pub mod diagnostic;
pub mod expect;
pub mod fault;
mod file_kind;
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
pub use file_kind::{FileKind, SETTINGS_FILE};
pub use find::{FoundScenarios, find, list_files};
pub use load::{load, load_copies, load_with_diagnostics};
pub use parse::parse;
pub use platebench_plate::input;
pub use scenario::{AUTO_MODEL, Controller, Gains, InputFile, Scenario, Spread, Trials};
pub use unjudged::unjudged_changes;
pub use variation::Variation;
pub use window::{ChangingProfile, Window};
