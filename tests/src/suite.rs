//! Runs a suite for the tests: `SUITE` names its scenarios, `OUT` the folder of its runs.

use platebench_native_tests::Suite;
use std::process::ExitCode;

fn main() -> ExitCode {
    let variable = |name: &str| std::env::var_os(name).unwrap_or_default();
    Suite::new(variable("SUITE"), variable("OUT")).rig("hosted").run()
}
