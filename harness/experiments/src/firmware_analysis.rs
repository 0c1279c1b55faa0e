//! Analyses the firmware on the emulated rig: which machine code the scenarios execute, and which
//! changes of it they detect. See `docs/coverage.md` and `docs/mutation.md`.

pub mod code_map;
pub mod coverage;
pub mod coverage_text;
pub mod error;
pub mod lcov;
pub mod mutation;
mod source_map;
pub mod suite;
pub mod thumb;

pub use code_map::CodeMap;
pub use coverage::{Coverage, CoverageConfig, FileCoverage, measure_coverage};
pub use error::AnalysisError;
pub use mutation::{MutationConfig, MutationReport, measure_mutation};
pub use suite::Suite;
