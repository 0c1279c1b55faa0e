//! Defines the command line: arguments, wiring and exit codes. Other crates decide and measure.
//! This is a library so that the tests of the whole bench can build the same program.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]
#![cfg_attr(
    not(all(feature = "analysis", feature = "emulated", feature = "export", feature = "live")),
    allow(dead_code, unused_imports)
)]

mod acceptance;
mod baseline;
mod board;
#[cfg(feature = "export")]
mod campaign;
mod check;
mod command_line;
mod compare;
mod config;
mod exit;
mod generate;
mod identify;
mod new;
mod options;
mod outputs;
mod plate;
mod prompt;
mod replay;
mod report;
mod run;
mod run_plan;
mod selection;
mod shutdown;
mod stability;
mod stdio;
mod suite;
mod tune;

pub use command_line::{command, main};
