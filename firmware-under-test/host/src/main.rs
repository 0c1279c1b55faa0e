//! Starts the program; the library lets the workspace's tests start it under another name.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_host_controller::main()
}
