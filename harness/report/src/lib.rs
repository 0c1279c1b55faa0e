//! What people and machines read of a run: everything here is made from a run record and its stored traces.
//!
//! * [`console`]: tables for a terminal, and progress while a run goes on.
//! * [`junit`]: `junit.xml` for continuous integration.
//! * [`tap`], [`markdown`], [`annotations`], [`events`]: the same for other readers, docs/formats.md describes each.
//! * [`html`]: `report.html`, one file that needs nothing else.
//! * [`traceability`]: `traceability.csv`, from requirement to trace.
//! * [`shown`]: limits, values and units in words, the same in every report.
//! * [`comparison`]: a response beside its baseline.
//! * [`map`]: spectral radius over period and delay, with measured boundaries.
//! * [`identification`]: tables and fitted curves of a plate.
//! * [`chart`]: what the bench measures of itself, drawn.
//!
//! Neighbours: `platebench-verdict` decides and owns the record, `platebench-trace` reads what happened. Nothing is
//! judged here and nothing is measured: a number in a report stands in the record or in a trace. Exit codes are the
//! command line's.

pub mod annotations;
pub mod chart;
pub mod comparison;
pub mod console;
mod cost;
mod error;
pub mod events;
mod evidence;
mod history;
pub mod html;
pub mod identification;
pub mod junit;
pub mod map;
pub mod markdown;
pub mod shown;
pub mod tap;
mod timing;
pub mod traceability;

pub use console::{Progress, ProgressKind, Style};
pub use error::ReportError;
