//! Exports the traces of a run to Parquet, MDF4, MCAP and CSV. `docs/formats.md` describes the
//! formats.
//!
//! Every format has the same columns. Memory does not grow with the length of a trace. Existing
//! files are kept.

mod mcap;
mod mf4;
pub mod parquet;
mod run_export;
mod source;
mod table;

pub use run_export::{ExportFormat, ExportResult, export, select_scenarios};
pub use source::{ExportError, FLAG_COLUMNS, NUMBER_COLUMNS, Number};
