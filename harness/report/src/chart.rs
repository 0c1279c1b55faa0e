//! Draws charts as SVG with classes instead of colours, for light, dark and paper.

mod cells;
pub(crate) mod colours;
pub(crate) mod marks;
mod points;
mod strips;
pub(crate) mod time;

pub use cells::{HeatAxis, HeatFigure, HeatPanel, MapFigure, MapPanel, RigDelay};
pub use points::{LogLogChart, LogLogSeries, ScatterChart, ScatterPanel, ScatterPoint};
pub use strips::{MultiplesChart, MultiplesPoint, StripChart, StripRow};
pub use time::{FitChart, draw_exceedance};
