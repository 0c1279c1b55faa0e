//! Starts the bench for tests.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_cli::main()
}
