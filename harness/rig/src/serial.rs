//! A controller on a serial port.

use crate::link::{Line, Link, LinkError};
use crate::lock::{self, Holder};
use crate::port::Port;
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, ioctl_tiocexcl, tcflush, tcgetattr, tcsetattr};
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
    port: Port,
}

impl Serial {
    /// Opens the port at `path`. What it still holds from before is thrown away.
    ///
    /// # Errors
    /// [`SerialError`].
    pub fn open(path: &Path, baud: u32) -> Result<Self, SerialError> {
        let refused = |error: Errno| SerialError::Settings { port: path.to_owned(), baud, error: error.into() };
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = rustix::fs::open(path, flags, Mode::empty()).map_err(|error| match error {
            Errno::BUSY => SerialError::InUse { port: path.to_owned(), holder: lock::holder(path) },
            error => SerialError::Open { port: path.to_owned(), error: error.into() },
        })?;
        if !rustix::termios::isatty(&file) {
            return Err(SerialError::NoTerminal { port: path.to_owned() });
        }
        // Locked before anything is changed: the port may be somebody else's.
        if let Some(holder) = lock::lock(&file).map_err(refused)? {
            return Err(SerialError::InUse { port: path.to_owned(), holder });
        }
        set_up(&file, baud).map_err(refused)?;
        // Against programs that know nothing of the lock; ports that cannot are none the worse.
        if let Err(error) = ioctl_tiocexcl(&file) {
            debug!(port = %path.display(), %error, "other programs are not kept out");
        }
        lower_latency(path);
        tcflush(&file, QueueSelector::IOFlush).map_err(refused)?;
        Ok(Self { port: Port::new(file).map_err(refused)? })
    }
}

/// Raw, 8N1, no flow control, modem lines ignored.
fn set_up(file: &OwnedFd, baud: u32) -> rustix::io::Result<()> {
    let mut settings = tcgetattr(file)?;
    settings.make_raw();
    settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
    settings.control_modes &= !(ControlModes::CSTOPB | ControlModes::CRTSCTS);
    settings.set_speed(baud)?;
    tcsetattr(file, OptionalActions::Now, &settings)
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
