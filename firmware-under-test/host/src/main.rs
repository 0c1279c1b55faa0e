//! See the library, which tests of the whole bench start under a name of their own.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_host_controller::main()
}
