//! Runs the controller as a program that uses a serial port or a pseudo-terminal.
//!
//! ```text
//! platebench-host-controller PORT [--baud N] [--log FILE] [--unique HEX]
//! ```
//!
//! The program replaces a board: `platebench run --rig "exec:platebench-host-controller {port}"`.
//! If the line hangs up, the program continues until its own watchdog has set 0 V.
//!
//! Exit codes: 0 after a hang-up with the drive at 0 V, 1 if port or log failed, 2 for wrong usage.

mod arguments;
mod log;
mod port;
mod program;

pub use program::main;
