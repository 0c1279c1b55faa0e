//! Two processes never drive one port.
//!
//! An advisory lock (`flock`) on the port's own file: the kernel holds it and lets it go when the process ends, however it ends, so that nothing is left to be
//! cleaned up. Who holds it stands in `/proc/locks`.

use rustix::fd::AsFd;
use rustix::fs::{FlockOperation, Stat, flock, fstat, major, minor, stat};
use rustix::io::Errno;
use std::fmt;
use std::fs;
use std::path::Path;

/// Whoever drives the port already.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holder {
    /// Its process and that process's command line, where this one may see them.
    process: Option<(u32, String)>,
}

impl fmt::Display for Holder {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.process {
            Some((pid, command)) if command.is_empty() => write!(formatter, "process {pid}"),
            Some((pid, command)) => write!(formatter, "process {pid} (`{command}`)"),
            None => formatter.write_str("another process, which cannot be seen from here"),
        }
    }
}

/// Locks `file` for as long as it is open. Whoever holds it already where it is taken.
pub(crate) fn lock(file: impl AsFd) -> rustix::io::Result<Option<Holder>> {
    match flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(None),
        Err(Errno::WOULDBLOCK) => Ok(Some(Holder::of(&fstat(&file)?))),
        Err(error) => Err(error),
    }
}

/// Whoever holds the port at `path`, which could not be opened, where it is held and the holder can be seen.
pub(crate) fn holder_of(path: &Path) -> Option<Holder> {
    stat(path).ok().map(|status| Holder::of(&status)).filter(|holder| holder.process.is_some())
}

impl Holder {
    fn of(status: &Stat) -> Self {
        let locks = fs::read_to_string("/proc/locks").unwrap_or_default();
        let process = holder_in(&locks, (major(status.st_dev), minor(status.st_dev)), status.st_ino).map(|pid| {
            let words = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let words = words.split(|&byte| byte == 0).filter(|word| !word.is_empty());
            (pid, words.map(String::from_utf8_lossy).collect::<Vec<_>>().join(" "))
        });
        Self { process }
    }
}

/// `1: FLOCK  ADVISORY  WRITE 9494 fe:00:10021135 0 EOF`: pid, then device in hexadecimal and inode. Those who wait stand behind an arrow.
fn holder_in(locks: &str, (major, minor): (u32, u32), inode: u64) -> Option<u32> {
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
    fn the_holder_is_found_by_device_and_inode() {
        assert_eq!(holder_in(LOCKS, (0xfe, 0), 10_021_135), Some(9494));
        assert_eq!(holder_in(LOCKS, (0, 0x18), 6), Some(701));
        assert_eq!(holder_in(LOCKS, (0, 0x18), 8), None);
        assert_eq!(holder_in("x\n\n1: FLOCK", (0, 0x18), 6), None);
    }

    #[test]
    fn a_holder_outside_what_can_be_seen_is_not_named() {
        assert_eq!(holder_in(LOCKS, (0, 0x18), 7), None);
        assert_eq!(Holder { process: None }.to_string(), "another process, which cannot be seen from here");
    }

    #[test]
    fn a_file_that_is_locked_names_this_process_and_is_free_once_closed() {
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
