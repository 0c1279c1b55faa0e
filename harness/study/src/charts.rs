//! Measures and draws speed against accuracy, and where loops become unstable. Each chart returns
//! blocks of a page and files as text.

pub mod ladder;
mod law_results;
mod law_variants;
pub mod laws;
mod measured_run;
pub mod precision;
pub mod scenes;
mod section;
pub mod stability;

pub use law_results::{LawScenario, load_law_scenarios};
pub use section::{ChartError, ChartSection};
