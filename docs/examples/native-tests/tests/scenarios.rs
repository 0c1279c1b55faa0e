//! One test for each scenario below `scenarios`.

use platebench_native_tests::Suite;
use std::process::ExitCode;

fn main() -> ExitCode {
    // The bench's own controller; a project names its own: `emulated:firmware.elf`, or `exec:controller {port}`.
    Suite::new("scenarios", concat!(env!("CARGO_TARGET_TMPDIR"), "/platebench")).rig("hosted").run()
}
