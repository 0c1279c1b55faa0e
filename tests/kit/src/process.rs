//! Runs other programs in tests.

use std::env;
use std::ffi::OsStr;
use std::io::Write;
use std::process::{Child, Command};

/// If this variable is 1, a missing program fails the test instead of skipping it.
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";

#[derive(Debug)]
pub struct ChildGuard(pub Child);

impl Drop for ChildGuard {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns a command that starts `program` with the default actions of SIGHUP, SIGINT and SIGQUIT. Under
/// `nohup` or in the background of a shell, the tests ignore them, and a program inherits that.
#[must_use]
pub fn command_with_default_signals(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("env");
    command.arg("--default-signal=HUP,INT,QUIT").arg(program);
    command
}

/// # Panics
/// If `PLATEBENCH_REQUIRE_ALL=1`.
pub fn skip_without(what: &str) {
    let required = env::var(REQUIRE_ALL).is_ok_and(|value| value == "1");
    assert!(!required, "{what} is missing and {REQUIRE_ALL}=1: ci/install-test-tools");
    // The test harness captures `eprintln!`, but not this.
    let _ = writeln!(std::io::stderr(), "NOT TESTED: {what} is missing (ci/install-test-tools)");
}
