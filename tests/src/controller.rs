use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_host_controller::main()
}
