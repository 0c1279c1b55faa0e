//! Writes pages: HTML in one file that loads nothing.
//!
//! * `report_page`: `report.html`, from its parts `summary`, `run_comparison`, `scenario`, `cost`,
//!   `environment`.
//! * `trace_data`, `curves`, `grid`, `golden`, `markers`, `resolution`: from traces to sampled curves.
//! * `scenario_figures`, `figure`: which curves a figure shows.
//! * `drawing`, `script`, `encode`: figures as SVG and as data of the interactive plots.
//! * `block_page`: pages of texts, tables and drawings.
//! * `frame`, `elements`: frame and small parts of every page.

mod block_page;
mod cost;
mod curves;
mod drawing;
mod elements;
mod encode;
mod environment;
mod figure;
mod frame;
mod golden;
mod grid;
mod markers;
mod report_page;
mod resolution;
mod run_comparison;
mod scenario;
mod scenario_figures;
mod script;
mod summary;
mod trace_data;

pub use block_page::{BlockPage, PageBlock};
pub use elements::verdict_badge;
pub use frame::page_frame;
pub use report_page::{COMPARISON_FILE, FILE, IsTraceChanged, ReportPage, write};
