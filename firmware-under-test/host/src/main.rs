//! Calls the library's `main`, which the workspace's tests also start under another program name.

use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_host_controller::main()
}
