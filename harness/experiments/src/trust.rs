//! Measures the bench's own errors: the kill rate over mutants and the false-alarm rate over
//! correct controllers. An expectation on one of a mutant's metrics catches the mutant if the
//! mutant fails it and the reference controller passes it. An inconclusive verdict catches nothing.
//! See `docs/trust.md`.

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
