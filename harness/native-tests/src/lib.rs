//! A folder of scenarios as the tests of another project: `cargo test` plays them, one test each.
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
//! * [`suite`]: what is played to what, and the test program that comes of it.
//! * [`error`]: why there is no suite, and how the program ends then.
//! * `play`: one test.
//!
//! The program understands the arguments of any Rust test and what `cargo nextest` asks for. How to use it: `docs/native-tests.md`.
//! What is played and how it is judged is none of this crate's business: it only says `ok` or `FAILED`.

pub mod error;
mod play;
pub mod suite;

pub use error::SuiteError;
pub use suite::Suite;
