//! Finds a Python interpreter for the example controller.

use std::process::{Command, Stdio};

/// If set, a missing tool fails the test instead of skipping it.
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";

/// Distributions may install pyserial for another Python than the first one on the path.
const PYTHONS: [&str; 2] = ["python3", "/usr/bin/python3"];

/// A Python with pyserial; `None`, with a message, if there is none.
///
/// # Panics
/// If there is none and `PLATEBENCH_REQUIRE_ALL` is set.
pub fn python_with_pyserial() -> Option<&'static str> {
    let has_serial = |python: &&str| {
        let mut command = Command::new(python);
        let status = command.args(["-c", "import serial"]).stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    };
    let python = PYTHONS.into_iter().find(has_serial);
    if python.is_none() {
        assert!(std::env::var_os(REQUIRE_ALL).is_none(), "python3 or pyserial is missing: ci/install-test-tools");
        eprintln!("NOT TESTED: python3 or pyserial is missing (ci/install-test-tools)");
    }
    python
}
