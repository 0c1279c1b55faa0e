//! Provides fixtures that the tests of several crates share: the paper's plate, its configuration and the repository's scenarios.
//!
//! A dev-dependency only. The unit tests of `wire` and `scenario` cannot use it: they would see two versions of their own types.

mod configuration;
mod python;
mod scenarios;

pub use configuration::CONFIGURE;
pub use python::python_with_pyserial;
pub use scenarios::{PLATE, load_scenario, parse_scenario, scenario_path, workspace_root};
