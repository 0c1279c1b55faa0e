//! Renders run records and traces. Every number comes from a record or a trace.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

#[cfg(feature = "export")]
pub mod export;
pub mod format;
pub mod live;
mod record_queries;
mod time_chart;

pub use record_queries::scripts_not_played;
pub use text::console::{Detail, Progress, ProgressKind, counts_so_far, slow_scenarios};
pub use text::{comparison, console, events, github, junit, scenario_list, traceability};
pub use time_chart::{FitChart, draw_exceedance};

/// Writes `report.html`, which loads no other file.
pub mod page {
    mod curves;
    mod elements;
    mod figure;
    mod markers;
    mod overview;
    mod report_page;
    mod scenario;
    mod script;
    mod trace_data;

    pub use elements::scenario_anchor;
    pub use report_page::{COMPARISON_FILE, FILE, IsTraceChanged, ReportPage, write};
    pub use trace_data::{MAX_TRIALS, RowCache};
}

/// Writes a run as text, for people and for machines.
pub mod text {
    pub mod comparison;
    pub mod console;
    pub mod events;
    pub mod github;
    pub(crate) mod history;
    pub mod junit;
    pub mod scenario_list;
    pub(crate) mod timing;
    pub mod traceability;
}
