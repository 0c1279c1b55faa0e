//! Locks a port or a board with `flock`. The kernel releases the lock when the process ends, also
//! after a crash.

use rustix::fd::AsFd;
use rustix::fs::{FlockOperation, Stat, flock, fstat, major, minor, stat};
use rustix::io::Errno;
use std::fmt;
use std::fs;
use std::path::Path;

#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LockHolder {
    /// Number and command line of the process; `None` if this user cannot see it.
    process: Option<(u32, String)>,
}

impl fmt::Display for LockHolder {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.process {
            Some((pid, command)) if command.is_empty() => write!(formatter, "process {pid}"),
            Some((pid, command)) => write!(formatter, "process {pid} (`{command}`)"),
            None => formatter.write_str("another process, which is not visible to this user"),
        }
    }
}

/// Locks `file` until it is closed. Returns the holder if another handle has the lock.
pub fn lock(file: impl AsFd) -> rustix::io::Result<Option<LockHolder>> {
    match flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(None),
        Err(Errno::WOULDBLOCK) => Ok(Some(LockHolder::from_status(&fstat(&file)?))),
        Err(error) => Err(error),
    }
}

pub(crate) fn holder_of(path: &Path) -> Option<LockHolder> {
    stat(path).ok().map(|status| LockHolder::from_status(&status)).filter(|holder| holder.process.is_some())
}

impl LockHolder {
    fn from_status(status: &Stat) -> Self {
        let locks = fs::read_to_string("/proc/locks").unwrap_or_default();
        let process = parse_holder(&locks, (major(status.st_dev), minor(status.st_dev)), status.st_ino).map(|pid| {
            let words = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let words = words.split(|&byte| byte == 0).filter(|word| !word.is_empty());
            (pid, words.map(String::from_utf8_lossy).collect::<Vec<_>>().join(" "))
        });
        Self { process }
    }
}

/// Returns the number of the process that holds the lock. Lines of waiting processes contain an
/// arrow, so that they do not match.
fn parse_holder(locks: &str, (major, minor): (u32, u32), inode: u64) -> Option<u32> {
    let file = format!("{major:02x}:{minor:02x}:{inode}");
    locks.lines().find_map(|line| match line.split_whitespace().collect::<Vec<_>>()[..] {
        [_, "FLOCK", _, _, pid, held, ..] if held == file => pid.parse().ok().filter(|&pid| pid > 0),
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOCKS: &str = "\
1: FLOCK  ADVISORY  WRITE 9494 fe:00:10021135 0 EOF
1: -> FLOCK  ADVISORY  WRITE 9572 fe:00:10021135 0 EOF
2: POSIX  ADVISORY  WRITE 700 00:18:6 0 EOF
3: FLOCK  ADVISORY  WRITE 701 00:18:6 0 EOF
4: FLOCK  ADVISORY  WRITE 0 00:18:7 0 EOF
";

    #[test]
    fn finds_the_holder_by_device_and_inode() {
        assert_eq!(parse_holder(LOCKS, (0xfe, 0), 10_021_135), Some(9494));
        assert_eq!(parse_holder(LOCKS, (0, 0x18), 6), Some(701));
        assert_eq!(parse_holder(LOCKS, (0, 0x18), 8), None);
        assert_eq!(parse_holder("x\n\n1: FLOCK", (0, 0x18), 6), None);
        // The kernel shows a holder in another PID namespace as process 0.
        assert_eq!(parse_holder(LOCKS, (0, 0x18), 7), None);
        assert_eq!(LockHolder { process: None }.to_string(), "another process, which is not visible to this user");
    }

    #[test]
    fn locks_a_file_until_it_is_closed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("port");
        let first = fs::File::create(&path).unwrap();
        let second = fs::File::open(&path).unwrap();
        assert_eq!(lock(&first).unwrap(), None);
        let (pid, command) = lock(&second).unwrap().unwrap().process.unwrap();
        assert_eq!(pid, std::process::id());
        assert!(command.contains("platebench_rig"), "{command}");
        assert_eq!(holder_of(&path).unwrap().process.unwrap().0, pid);
        drop(first);
        assert_eq!(holder_of(&path), None);
        assert_eq!(lock(&second).unwrap(), None);
    }
}
