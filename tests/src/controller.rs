//! The controller that plays the board, once more, for tests that start it as a process.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_host_controller::main()
}
