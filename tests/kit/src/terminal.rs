#![allow(clippy::unwrap_used, reason = "a failed fixture fails the test")]

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::fs::File;

/// Returns the master end of a new pseudo-terminal and the path of its slave end.
///
/// # Panics
/// If the system has no pseudo-terminal left.
#[must_use]
pub fn open_terminal() -> (File, String) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let path = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
    (File::from(master), path)
}
