//! Opens a serial port of this computer. Locks a port or a board with `flock`: the kernel releases
//! the lock when the process ends, also after a crash.

use crate::port::Port;
use rustix::fd::AsFd;
use rustix::fs::{FlockOperation, Mode, OFlags, Stat, flock, fstat, major, minor, stat};
use rustix::io::Errno;
use serialport::{ClearBuffer, SerialPort as _, TTYPort};
use std::path::{Path, PathBuf};
use std::{fmt, fs};
use tracing::{debug, info};

#[derive(Debug, thiserror::Error)]
pub enum SerialError {
    #[error("cannot open {}: {error}{}", port.display(), known_ports(error))]
    Open { port: PathBuf, error: std::io::Error },
    #[error("{} is in use by {holder}", port.display())]
    InUse { port: PathBuf, holder: LockHolder },
    #[error("{} is not a serial port", port.display())]
    NotATerminal { port: PathBuf },
    #[error("{} cannot be set to {baud} baud: {error}", port.display())]
    Settings { port: PathBuf, baud: u32, error: std::io::Error },
}

/// Hint for a port that does not exist.
fn known_ports(error: &std::io::Error) -> String {
    if error.kind() != std::io::ErrorKind::NotFound {
        return String::new();
    }
    let ports = serialport::available_ports().unwrap_or_default();
    let names: Vec<_> = ports.into_iter().map(|port| port.port_name).collect();
    if names.is_empty() {
        return "; this computer has no serial port: connect the board".to_owned();
    }
    format!("; expected a port of this computer: {}", names.join(", "))
}

/// Serial port with 8 data bits, no parity, 1 stop bit and no flow control. It is locked against
/// other processes.
pub type SerialLink = Port<TTYPort>;

impl SerialLink {
    pub fn open(path: &Path, baud: u32) -> Result<Self, SerialError> {
        check_free(path)?;
        // `TTYPort::open` sets TIOCEXCL and `flock`, so that no other process can open the port.
        let port = TTYPort::open(&serialport::new(path.to_string_lossy(), baud)).map_err(|error| {
            let port = path.to_owned();
            match holder_of(path) {
                Some(holder) => SerialError::InUse { port, holder },
                None => SerialError::Settings { port, baud, error: error.into() },
            }
        })?;
        set_low_latency(path);
        if let Err(error) = port.clear(ClearBuffer::All) {
            debug!(port = %path.display(), %error, "earlier bytes in the port are not discarded");
        }
        Ok(Self::new(port))
    }
}

/// Fails if another process uses the port. Runs before the bench changes a setting of the port.
fn check_free(path: &Path) -> Result<(), SerialError> {
    let port = || path.to_owned();
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = rustix::fs::open(path, flags, Mode::empty()).map_err(|error| match error {
        Errno::ISDIR => SerialError::NotATerminal { port: port() },
        Errno::BUSY => SerialError::InUse { port: port(), holder: holder_of(path).unwrap_or_default() },
        error => SerialError::Open { port: port(), error: error.into() },
    })?;
    if !rustix::termios::isatty(&file) {
        return Err(SerialError::NotATerminal { port: port() });
    }
    match lock_file(&file) {
        Ok(None) => Ok(()),
        Ok(Some(holder)) => Err(SerialError::InUse { port: port(), holder }),
        Err(error) => Err(SerialError::Open { port: port(), error: error.into() }),
    }
}

/// Sets the latency timer of an FTDI adapter from 16 ms to 1 ms. Other ports have no such timer.
#[expect(clippy::disallowed_methods, reason = "the kernel reads sysfs in place")]
fn set_low_latency(path: &Path) {
    let name = path.canonicalize().ok().and_then(|path| path.file_name().map(PathBuf::from)).unwrap_or_default();
    let timer = Path::new("/sys/class/tty").join(name).join("device/latency_timer");
    let Ok(before) = fs::read_to_string(&timer) else { return };
    if before.trim() == "1" {
        return;
    }
    match fs::write(&timer, "1") {
        Ok(()) => debug!(before = before.trim(), "latency timer set to 1 ms"),
        Err(error) => {
            let ms = before.trim();
            info!(%error, "{} is {ms} ms and cannot be changed: answers arrive up to {ms} ms later", timer.display());
        }
    }
}

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
pub fn lock_file(file: impl AsFd) -> rustix::io::Result<Option<LockHolder>> {
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
        assert_eq!(lock_file(&first).unwrap(), None);
        let (pid, command) = lock_file(&second).unwrap().unwrap().process.unwrap();
        assert_eq!(pid, std::process::id());
        assert!(command.contains("platebench_rig"), "{command}");
        assert_eq!(holder_of(&path).unwrap().process.unwrap().0, pid);
        drop(first);
        assert_eq!(holder_of(&path), None);
        assert_eq!(lock_file(&second).unwrap(), None);
    }
}
