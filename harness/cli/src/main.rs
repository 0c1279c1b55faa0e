use std::process::ExitCode;

fn main() -> ExitCode {
    platebench_cli::main()
}
