use crate::process::skip_without;
use std::process::{Command, Stdio};

/// Distributions may install pyserial for another Python than the first one on the search path.
const PYTHONS: [&str; 2] = ["python3", "/usr/bin/python3"];

/// Returns a Python with pyserial, or prints a message and returns `None` if there is none.
///
/// # Panics
/// If there is no such Python and `PLATEBENCH_REQUIRE_ALL=1`.
pub fn python_with_pyserial() -> Option<&'static str> {
    let has_serial = |python: &&str| {
        let mut command = Command::new(python);
        let status = command.args(["-c", "import serial"]).stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    };
    let python = PYTHONS.into_iter().find(has_serial);
    if python.is_none() {
        skip_without("python3 or pyserial");
    }
    python
}
