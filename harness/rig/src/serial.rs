//! A controller on a serial port.

use crate::link::{Line, Link, LinkError};
use crate::lock::{self, Holder};
use crate::port::Port;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use serialport::{ClearBuffer, SerialPort as _, TTYPort};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tracing::{debug, info};

/// Bits per second where none are given: what the firmware that comes with the bench talks at.
pub const DEFAULT_BAUD: u32 = 1_000_000;

/// Why a port cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SerialError {
    /// It is not there, or not for us.
    #[error("cannot open {}: {error}", port.display())]
    Open {
        /// Which port.
        port: PathBuf,
        /// Why not.
        error: std::io::Error,
    },
    /// Somebody else drives it.
    #[error("{} is in use by {holder}", port.display())]
    InUse {
        /// Which port.
        port: PathBuf,
        /// By whom.
        holder: Holder,
    },
    /// What is there is no serial port.
    #[error("{} is not a serial port", port.display())]
    NoTerminal {
        /// What is there.
        port: PathBuf,
    },
    /// The port refuses its settings.
    #[error("{} cannot be set to {baud} baud: {error}", port.display())]
    Settings {
        /// Which port.
        port: PathBuf,
        /// Wished bits per second.
        baud: u32,
        /// Why not.
        error: std::io::Error,
    },
}

/// A port, 8N1 without flow control, locked against other benches for as long as it lives.
#[derive(Debug)]
pub struct Serial {
    port: Port<TTYPort>,
}

impl Serial {
    /// Opens the port at `path`. What it still holds from before is thrown away.
    ///
    /// # Errors
    /// [`SerialError`].
    pub fn open(path: &Path, baud: u32) -> Result<Self, SerialError> {
        check_free(path)?;
        // Opened for this process alone, with a lock of the kernel's that other benches see.
        let port = TTYPort::open(&serialport::new(path.to_string_lossy(), baud)).map_err(|error| {
            let port = path.to_owned();
            match lock::holder_of(path) {
                Some(holder) => SerialError::InUse { port, holder },
                None => SerialError::Settings { port, baud, error: error.into() },
            }
        })?;
        lower_latency(path);
        if let Err(error) = port.clear(ClearBuffer::All) {
            debug!(port = %path.display(), %error, "what the port held before is not thrown away");
        }
        Ok(Self { port: Port::new(port) })
    }
}

/// Looks whether `path` can be opened, is a terminal and is nobody else's, before anything about it is changed.
fn check_free(path: &Path) -> Result<(), SerialError> {
    let port = || path.to_owned();
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = rustix::fs::open(path, flags, Mode::empty()).map_err(|error| match error {
        // A folder is one of the things that are none.
        Errno::ISDIR => SerialError::NoTerminal { port: port() },
        Errno::BUSY => SerialError::InUse { port: port(), holder: lock::holder_of(path).unwrap_or_default() },
        error => SerialError::Open { port: port(), error: error.into() },
    })?;
    if !rustix::termios::isatty(&file) {
        return Err(SerialError::NoTerminal { port: port() });
    }
    match lock::lock(&file) {
        Ok(None) => Ok(()),
        Ok(Some(holder)) => Err(SerialError::InUse { port: port(), holder }),
        Err(error) => Err(SerialError::Open { port: port(), error: error.into() }),
    }
}

/// FTDI adapters hold received bytes back for 16 ms unless told otherwise; other ports have no such setting.
fn lower_latency(path: &Path) {
    let name = path.canonicalize().ok().and_then(|path| path.file_name().map(PathBuf::from)).unwrap_or_default();
    let timer = Path::new("/sys/class/tty").join(name).join("device/latency_timer");
    let Ok(before) = fs::read_to_string(&timer) else { return };
    if before.trim() == "1" {
        return;
    }
    match fs::write(&timer, "1") {
        Ok(()) => debug!(before = before.trim(), "latency timer set to 1 ms"),
        Err(error) => {
            info!(%error, "{} is {} ms and cannot be lowered: answers come that much later", timer.display(), before.trim());
        }
    }
}

impl Link for Serial {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.port.exchange(bytes, answer)
    }

    fn pass(&mut self, _now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.port.pass(said)
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        Some(&mut self.port)
    }
}
