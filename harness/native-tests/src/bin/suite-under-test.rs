//! A suite as another project has it, for the tests to start: `SUITE` names its scenarios, `OUT` where its runs go.

use platebench_native_tests::Suite;
use std::process::ExitCode;

fn main() -> ExitCode {
    let named = |name: &str| std::env::var_os(name).unwrap_or_default();
    Suite::new(named("SUITE"), named("OUT")).rig("hosted").run()
}
