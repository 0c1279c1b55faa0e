//! The traces of a run in the formats that other programs read: Parquet, MDF4, MCAP and CSV.
//!
//! Every format holds the same [`columns`]: the numbers of a trace bit for bit, its flags one by one, which scenario
//! and trial they are of, and the unit of each. A trace is read and written row by row, so that memory does not grow
//! with its length; a file gets its name once it is whole, and a file that is there is never written over.
//!
//! * [`export`]: which files are made, and that nothing is lost on the way.
//! * [`columns`]: names, units and meanings.
//!
//! Neighbours: `platebench-trace` reads rows, `platebench-verdict` owns the record. Which run, and what becomes of an
//! error, is the command line's. Nothing is judged or computed here. docs/formats.md describes each format.

pub mod columns;
mod error;
mod export;
mod mcap;
mod mf4;
mod parquet;
mod source;
mod table;

pub use error::ExportError;
pub use export::{ExportFormat, ExportResult, export, select_scenarios};
