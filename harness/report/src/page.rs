//! Writes HTML pages, each in one file that loads no other.

mod boards;
mod chart_section;
mod cost;
mod curves;
mod drawing;
mod elements;
mod encode;
mod environment;
mod figure;
pub(crate) mod frame;
mod golden;
mod grid;
mod kept_rows;
mod limit_marks;
mod markers;
mod navigation;
mod report_page;
mod resolution;
mod run_comparison;
mod scenario;
mod scenario_figures;
mod script;
mod summary;
mod trace_data;
mod trend;

pub use chart_section::{ChartSection, write_chart_page};
pub use elements::scenario_anchor;
pub use frame::page_frame;
pub use kept_rows::RowCache;
pub use report_page::{COMPARISON_FILE, FILE, IsTraceChanged, ReportPage, write};
pub use trace_data::MAX_TRIALS;
