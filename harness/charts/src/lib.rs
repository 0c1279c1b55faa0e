//! Draws charts of cost and error of methods, models and laws, as page blocks and files. Running
//! scenarios does not need this crate.

mod cost;
mod error;
pub mod integration;
pub mod ladder;
mod law_results;
mod law_variants;
pub mod laws;
mod measured_run;
pub mod precision;
pub mod scenes;

pub use error::ChartError;
pub use law_results::{LawScenario, load_law_scenarios};
