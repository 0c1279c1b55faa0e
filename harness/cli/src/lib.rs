//! Defines the command line: arguments, wiring and exit codes. Other crates decide and measure.
//! This is a library so that the tests of the whole bench can build the same program.

#![cfg_attr(not(all(feature = "emulated", feature = "export", feature = "live")), allow(dead_code, unused_imports))]

mod acceptance;
mod args;
mod baseline;
mod board;
mod board_args;
mod build_info;
#[cfg(feature = "export")]
mod campaign;
mod check;
mod clock;
mod color;
mod compare;
mod config;
mod exit;
mod failure;
mod generate;
mod identify;
mod live;
mod logging;
mod new;
mod options;
mod outputs;
mod plate;
mod plate_warnings;
mod program;
mod prompt;
mod renamed_commands;
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

pub use program::{command, main};
