//! Defines the command line: arguments, wiring and exit codes. Other crates decide and measure.
//! This is a library so that the tests of the whole bench can build the same program.

#![cfg_attr(not(all(feature = "emulated", feature = "export", feature = "live")), allow(dead_code, unused_imports))]

mod accept;
mod args;
mod baseline;
mod board_args;
mod boards;
mod build_info;
#[cfg(feature = "export")]
mod campaign;
mod check;
mod clock;
mod color;
mod compare;
mod completions;
mod config;
#[cfg(feature = "emulated")]
mod coverage;
mod emulate;
mod exit;
mod explore;
#[cfg(feature = "export")]
mod export;
#[cfg(feature = "export")]
mod export_fmu;
mod failure;
mod identify;
mod judge;
mod live;
mod logging;
mod man;
mod merge;
#[cfg(feature = "emulated")]
mod mutate;
mod new;
mod options;
mod outputs;
mod plate_warnings;
mod program;
mod prompt;
mod replay;
mod report;
mod run;
mod run_plan;
mod schema;
mod selection;
mod shutdown;
mod soak;
mod stability;
mod stdio;
mod trust;
mod tune;

pub use program::{command, main};
