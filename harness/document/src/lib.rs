//! Renders documents as text, HTML, Markdown and CSV, and charts as SVG. Knows nothing of runs and scenarios.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod document;
mod escape;
pub mod format;
#[cfg(feature = "parquet")]
pub mod parquet;
mod style;
mod table;

pub use document::{AreaLink, Block, ChartSection, Document, Figure, page_frame, write_chart_page};
pub use escape::without_formula;
pub use format::NOTHING;
pub use style::Style;
pub use table::{Alignment, Cell, Column, Table, verdict_badge};

/// Draws charts as SVG with classes instead of colours, for light, dark and paper.
pub mod chart {
    mod heat;
    pub mod marks;
    pub mod panels;
    mod scatter;

    pub use heat::{HeatAxis, HeatFigure, HeatPanel, HeatScale};
    pub use scatter::{ScatterChart, ScatterPanel, ScatterPoint};
}
