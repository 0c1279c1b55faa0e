//! The bench, once more, for tests that start it as a process.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_cli::main()
}
