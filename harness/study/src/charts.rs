//! Draws charts of cost and error of methods, models and laws, and of stability limits, as page
//! blocks and files.

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
