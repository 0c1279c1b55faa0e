//! Draws charts as SVG with classes instead of colours, for light, dark and paper.

pub(crate) mod colours;
mod exceedance;
mod fit;
mod heat;
mod loglog;
mod map;
mod multiples;
mod scatter;
mod strip;
pub(crate) mod svg;
pub(crate) mod time_chart;

pub use exceedance::draw_exceedance;
pub use fit::FitChart;
pub use heat::{HeatAxis, HeatFigure, HeatPanel};
pub use loglog::{LogLogChart, LogLogSeries};
pub use map::{MapFigure, MapPanel, RigDelay};
pub use multiples::{MultiplesChart, MultiplesPoint};
pub use scatter::{ScatterChart, ScatterPanel, ScatterPoint};
pub use strip::{StripChart, StripRow};
