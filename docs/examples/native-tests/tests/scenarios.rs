//! Runs each scenario below `scenarios` as a test.

use platebench_native_tests::Suite;
use std::process::ExitCode;

fn main() -> ExitCode {
    // The bench's own controller; name yours: `emulated:firmware.elf`, or `exec:controller {port}`.
    Suite::new("scenarios", concat!(env!("CARGO_TARGET_TMPDIR"), "/platebench")).rig("hosted").run()
}
