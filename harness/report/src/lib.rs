//! Renders run records and traces. Every number comes from a record or a trace.

pub mod chart;
pub mod document;
mod error;
#[cfg(feature = "export")]
pub mod export;
pub mod format;
pub mod live;
pub mod page;
mod record_queries;
pub mod text;

pub use document::Style;
pub use error::ReportError;
pub use text::console::{Detail, Progress, ProgressKind};
pub use text::{
    annotations, comparison, console, events, junit, markdown, scenario_list, tap, traceability, tube_plot,
};
