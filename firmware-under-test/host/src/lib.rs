//! Runs the controller on a computer, on a serial port or a pseudo-terminal.
//!
//! ```text
//! platebench-host-controller PORT [--baud N] [--log FILE] [--unique HEX]
//! ```
//!
//! Replaces a board: `platebench run --rig "exec:platebench-host-controller {port}"`. After the
//! line hangs up, the program continues until its own watchdog has set 0 V.
//!
//! Exit codes: 0 the line hung up and the drive is at 0 V · 1 port or log failed · 2 wrong usage.

mod arguments;
mod error;
mod log;
mod main_loop;
mod port;
mod program;

pub use program::main;
