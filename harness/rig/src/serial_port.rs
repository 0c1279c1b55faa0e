//! Opens a serial port of this computer and locks it against other processes.

use crate::port::Port;
use crate::port_lock::{self, LockHolder};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use serialport::{ClearBuffer, SerialPort as _, TTYPort};
use std::fs;
use std::path::{Path, PathBuf};
use tracing::{debug, info};

#[derive(Debug, thiserror::Error)]
pub enum SerialError {
    #[error("cannot open {}: {error}", port.display())]
    Open { port: PathBuf, error: std::io::Error },
    #[error("{} is in use by {holder}", port.display())]
    InUse { port: PathBuf, holder: LockHolder },
    #[error("{} is not a serial port", port.display())]
    NotATerminal { port: PathBuf },
    #[error("{} cannot be set to {baud} baud: {error}", port.display())]
    Settings { port: PathBuf, baud: u32, error: std::io::Error },
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
            match port_lock::holder_of(path) {
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
        Errno::BUSY => SerialError::InUse { port: port(), holder: port_lock::holder_of(path).unwrap_or_default() },
        error => SerialError::Open { port: port(), error: error.into() },
    })?;
    if !rustix::termios::isatty(&file) {
        return Err(SerialError::NotATerminal { port: port() });
    }
    match port_lock::lock(&file) {
        Ok(None) => Ok(()),
        Ok(Some(holder)) => Err(SerialError::InUse { port: port(), holder }),
        Err(error) => Err(SerialError::Open { port: port(), error: error.into() }),
    }
}

/// Sets the latency timer of an FTDI adapter from 16 ms to 1 ms. Other ports have no such timer.
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
