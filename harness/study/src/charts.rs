//! Measures and draws speed against accuracy, and where loops become unstable.
//!
//! * [`precision`]: integration methods, error against cost.
//! * [`scenes`]: scenarios on every model of the plate.
//! * [`laws`]: control laws, response time against static error and repeatability.
//! * [`stability`]: stable steps of methods, stability boundaries of loops.
//!
//! Each chart returns blocks of a page and files as text. The caller writes them.

mod law_results;
pub mod laws;
pub mod precision;
pub mod scenes;
mod section;
pub mod stability;

pub use law_results::{LawScenario, load_law_scenarios};
pub use section::{ChartError, ChartSection};
