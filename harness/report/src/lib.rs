//! Renders run records and traces. Every number comes from a record or a trace.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod document;
mod error;
mod escape;
#[cfg(feature = "export")]
pub mod export;
pub mod format;
pub mod live;
mod record_queries;

pub use document::Style;
pub use error::ReportError;
pub use record_queries::scripts_not_played;
pub use text::console::{Detail, Progress, ProgressKind, counts_so_far, slow_scenarios};
pub use text::{comparison, console, events, github, junit, scenario_list, traceability};

/// Draws charts as SVG with classes instead of colours, for light, dark and paper.
pub mod chart {
    mod cells;
    pub(crate) mod marks;
    mod panels;
    mod points;
    mod strips;
    pub(crate) mod time;

    pub use cells::{HeatAxis, HeatFigure, HeatPanel, HeatScale, MapFigure, MapPanel, RigDelay};
    pub use points::{LogLogChart, LogLogSeries, ScatterChart, ScatterPanel, ScatterPoint};
    pub use strips::{MultiplesChart, MultiplesPoint, StripChart, StripRow};
    pub use time::{FitChart, draw_exceedance};
}

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

    pub use crate::document::{ChartSection, page_frame, write_chart_page};
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

    pub use crate::escape::{printable, printable_lines, without_formula};
}
