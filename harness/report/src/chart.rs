//! Draws: every drawing is SVG with classes instead of colours, for light, dark and paper.
//!
//! * `svg`: roles, code colours, drawing in CSS pixels.
//! * `colours`: the style of all drawings and pages.
//! * `time_chart`: lines, areas and marks over time.
//! * `exceedance`: where a response leaves its tolerance tube.
//! * `fit`: a recording and its fitted response.
//! * `loglog`: lines of points on two logarithmic axes.
//! * `scatter`: points by colour and shape, with limits.
//! * `strip`: one line of marks per item on a logarithmic axis.
//! * `map`: spectral radius over control period and loop delay.
//!
//! The callers measure and name what is drawn. Nothing here knows a metric, a method or a scenario.

pub(crate) mod colours;
mod exceedance;
mod fit;
mod loglog;
mod map;
mod scatter;
mod strip;
pub(crate) mod svg;
pub(crate) mod time_chart;

pub use exceedance::draw_exceedance;
pub use fit::FitChart;
pub use loglog::{LogLogChart, LogLogSeries};
pub use map::{MapFigure, MapPanel, RigDelay};
pub use scatter::{ScatterChart, ScatterPanel, ScatterPoint};
pub use strip::{StripChart, StripRow};
