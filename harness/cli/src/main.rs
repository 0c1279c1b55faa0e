//! The bench on the command line.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_cli::main()
}
