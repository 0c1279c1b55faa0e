//! Reads and checks scenario files.

mod bounds;
pub mod chip_fault;
mod definition;
pub mod diagnostic;
pub mod expect;
pub mod fault;
mod file_kind;
pub mod find;
pub mod load;
mod parse;
mod plate_warnings;
pub mod raw;
mod requirements;
pub mod schema;
mod text;
mod unjudged;
mod value_range;
pub mod variation;
mod window;

pub use crate::metrics::Metric;
pub use chip_fault::{BitFlipTarget, ChipFault, ChipFaultKind};
pub use definition::{AUTO_MODEL, Controller, Gains, InputFile, MAX_TRIALS, Scenario, Spread, Trials};
pub use diagnostic::{Diagnostic, suggestion};
pub use expect::{Aggregation, Expectation, Limit};
pub use fault::{Direction, Fault, FaultKind};
pub use file_kind::{FileKind, SETTINGS_FILE};
pub use find::{FoundScenarios, find, find_file_above, list_files, repeated_names};
pub use load::{load, load_copies, load_with_all_errors};
pub use parse::{parse, parse_bytes, parse_file};
pub use plate_warnings::plate_warnings;
pub use platebench_plate::input;
pub use requirements::{REQUIREMENTS_FILE, Requirement, read_requirements};
pub use text::read_text;
pub use unjudged::unjudged_changes;
pub use variation::Variation;
pub use window::{ChangingProfile, Window};
