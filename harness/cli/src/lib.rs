//! The command line: arguments, wiring and exit codes. The other crates decide and measure.
//! A library so that the whole-bench tests can build the same program.

mod accept;
mod args;
mod baseline;
mod build_info;
mod campaign;
mod chart;
mod chart_page;
mod check;
mod clock;
mod color;
mod compare;
mod completions;
mod config;
mod coverage;
mod emulate;
mod exit;
mod explore;
mod export;
mod export_fmu;
mod identify;
mod judge;
mod live;
mod logging;
mod man;
mod mutate;
mod new;
mod options;
mod outputs;
mod plate_file;
mod program;
mod prompt;
mod replay;
mod report;
mod run;
mod run_plan;
mod schema;
mod shutdown;
mod stability;
mod stdio;
mod tags;
mod trust;
mod tune;

pub use program::{command, main};
