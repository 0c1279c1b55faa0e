//! Runs a folder of scenarios as tests of another project: one `cargo test` case per scenario.
//!
//! ```no_run
//! // tests/scenarios.rs, with `harness = false` in Cargo.toml
//! use platebench_native_tests::Suite;
//! use std::process::ExitCode;
//!
//! fn main() -> ExitCode {
//!     Suite::new("scenarios", "target/platebench").rig("emulated:firmware.elf").run()
//! }
//! ```
//!
//! The program takes the arguments of a Rust test program and of `cargo nextest`. See
//! `docs/native-tests.md`.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod suite;

pub use suite::{Suite, SuiteError};
