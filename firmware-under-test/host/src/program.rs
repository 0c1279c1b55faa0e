//! Parses the arguments, runs the controller and sets the exit code.

use crate::arguments::{Arguments, USAGE};
use crate::main_loop;
use std::process::ExitCode;

pub fn main() -> ExitCode {
    let arguments = match Arguments::parse(std::env::args().skip(1)) {
        Ok(Some(arguments)) => arguments,
        Ok(None) => {
            println!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            eprintln!("platebench-host-controller: {error}\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    match main_loop::run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("platebench-host-controller: {error}");
            ExitCode::FAILURE
        }
    }
}
