//! Provides fixtures for the tests of several crates: plate, configuration, board,
//! scenarios.
//!
//! Unit tests of `wire` and `scenario` cannot use this crate: it would bring a second version of
//! their types.

mod board;
mod configuration;
mod identity;
mod process;
mod python;
mod scenarios;
mod terminal;

pub use board::{answer_line, random_configure, random_sample, serve_board, uniform, wave_sample};
pub use configuration::CONFIGURE;
pub use identity::IDENTITY;
pub use process::{ChildGuard, command_with_default_signals, skip_without};
pub use python::python_with_pyserial;
pub use scenarios::{PLATE, load_scenario, paper_plate, parse_scenario, scenario_path, workspace_root, write_scenario};
pub use terminal::open_terminal;
