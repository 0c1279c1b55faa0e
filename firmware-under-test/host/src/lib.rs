//! The controller on a computer, behind a serial port or a pseudo-terminal: the same `Device` as on the board, with the computer's clock for the board's timer.
//!
//! ```text
//! platebench-host-controller PORT [--baud N] [--log FILE]
//! ```
//!
//! It plays the board where there is none: `platebench run --rig "exec:platebench-host-controller {port}"`. When the line hangs up it goes on until its own watchdog has
//! taken the drive to 0 V, and then ends with code 0.
//!
//! Exit codes: 0 the line hung up and the drive is at 0 V · 1 port or log cannot be opened or fail · 2 wrong usage.

mod arguments;
mod board;
mod log;
mod port;

use arguments::Arguments;
use std::process::ExitCode;

/// Why the program ends early.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error("cannot open {port}: {error}")]
    Open { port: String, error: std::io::Error },
    #[error("{port} cannot be set to {baud} baud: {error}")]
    Settings { port: String, baud: u32, error: std::io::Error },
    #[error("cannot write {file}: {error}")]
    Log { file: String, error: std::io::Error },
}

/// The program. See the module for its arguments and exit codes.
pub fn main() -> ExitCode {
    let arguments = match Arguments::parse(std::env::args().skip(1)) {
        Ok(Some(arguments)) => arguments,
        Ok(None) => {
            println!("{}", arguments::USAGE);
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            eprintln!("platebench-host-controller: {error}\n{}", arguments::USAGE);
            return ExitCode::from(2);
        }
    };
    match board::run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("platebench-host-controller: {failure}");
            ExitCode::FAILURE
        }
    }
}
