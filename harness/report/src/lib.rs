//! Renders run records and traces.
//!
//! * [`text`]: console, JUnit, TAP, Markdown, annotations, events, CSV.
//! * [`page`]: HTML pages.
//! * [`chart`]: SVG drawings.
//! * [`mod@format`]: numbers, limits and verdicts as words, the same everywhere.
//!
//! This crate judges and measures nothing: every number comes from a record or a trace.

pub mod chart;
mod error;
pub mod format;
pub mod page;
mod record_queries;
pub mod text;

pub use error::ReportError;
pub use text::console::{Progress, ProgressKind, Style};
pub use text::{annotations, comparison, console, events, junit, markdown, tap, traceability};
