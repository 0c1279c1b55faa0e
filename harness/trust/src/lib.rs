//! Measures the bench's own errors: the kill rate over mutants and the false-alarm rate over clean
//! controllers.
//!
//! * [`mod@catalogue`]: the mutants, each with the metrics that should detect it.
//! * [`mod@clean_variants`]: correct controllers that differ from the firmware.
//! * [`mutant_controller`]: a link that changes messages to and from a controller.
//! * `mutants`: the changes.
//! * [`mod@play`]: plays and judges a scenario in memory.
//! * [`mod@measure`]: both rates.
//! * [`report`], [`mod@format`]: the result for machines and people.
//!
//! A mutant is caught if an expectation on one of its metrics fails that its reference passes.
//! `inconclusive` catches nothing. See `docs/trust.md`.

pub mod catalogue;
pub mod clean_variants;
pub mod format;
pub mod measure;
pub mod mutant_controller;
pub mod mutant_spec;
mod mutants;
pub mod play;
pub mod report;

pub use catalogue::catalogue;
pub use clean_variants::{CleanVariant, clean_variants};
pub use measure::{TrustConfig, measure};
pub use mutant_controller::{Mutant, MutantController};
pub use mutant_spec::{MutantSpec, ReferenceController};
pub use play::{PlayResult, TrustError, play};
pub use report::TrustReport;
