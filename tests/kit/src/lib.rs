//! Provides fixtures for the tests of several crates: plate, configuration, board, links and
//! scenarios.
//!
//! Unit tests of a crate below cannot use functions with types of that crate: the kit has a second
//! version of them. The unit tests of `rig` therefore include `scripted_link.rs`.

mod board;
mod configuration;
mod identity;
mod process;
mod python;
mod scenarios;
mod scripted_link;
mod terminal;

pub use board::{UNREACHABLE, answer_line, random_configure, random_sample, serve_board, uniform, wave_sample};
pub use configuration::CONFIGURE;
pub use identity::IDENTITY;
pub use process::{ChildGuard, command_with_default_signals, skip_without};
pub use python::python_with_pyserial;
pub use scenarios::{PLATE, load_scenario, paper_plate, parse_scenario, scenario_path, workspace_root, write_scenario};
pub use scripted_link::{ScriptedLink, commands, link_with_changed_answers, packets};
pub use terminal::open_terminal;
