//! Reads and writes a terminal in raw, non-blocking mode.

use crate::arguments::Arguments;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, tcgetattr, tcsetattr};
use std::time::Duration;

#[derive(Debug, thiserror::Error)]
pub(crate) enum HostError {
    #[error("cannot open {port}: {error}")]
    Open { port: String, error: std::io::Error },
    #[error("{port} cannot be set to {baud} baud: {error}")]
    Settings { port: String, baud: u32, error: std::io::Error },
    #[error("cannot write {file}: {error}")]
    Log { file: String, error: std::io::Error },
}

pub(crate) struct Port(OwnedFd);

pub(crate) enum PortInput<'a> {
    Bytes(&'a [u8]),
    TimedOut,
    HungUp,
}

impl Port {
    pub(crate) fn open(arguments: &Arguments) -> Result<Self, HostError> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = rustix::fs::open(&arguments.port, flags, Mode::empty())
            .map_err(|error| HostError::Open { port: arguments.port.clone(), error: error.into() })?;
        let settings = tcgetattr(&file).and_then(|mut settings| {
            settings.make_raw();
            settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
            settings.control_modes &= !(ControlModes::CSTOPB | ControlModes::CRTSCTS);
            settings.set_speed(arguments.baud)?;
            tcsetattr(&file, OptionalActions::Now, &settings)
        });
        settings.map_err(|error| {
            let (port, baud) = (arguments.port.clone(), arguments.baud);
            HostError::Settings { port, baud, error: error.into() }
        })?;
        Ok(Self(file))
    }

    pub(crate) fn receive<'a>(&self, buffer: &'a mut [u8], timeout: Duration) -> PortInput<'a> {
        let timeout = Timespec {
            tv_sec: i64::try_from(timeout.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: timeout.subsec_nanos().into(),
        };
        let _ = poll(&mut [PollFd::new(&self.0, PollFlags::IN)], Some(&timeout));
        match rustix::io::read(&self.0, &mut *buffer) {
            Ok(0) => PortInput::HungUp,
            Ok(count) => PortInput::Bytes(buffer.get(..count).unwrap_or_default()),
            Err(Errno::AGAIN | Errno::INTR) => PortInput::TimedOut,
            Err(_) => PortInput::HungUp,
        }
    }

    /// Drops the bytes that the line does not accept at once, as a UART does.
    pub(crate) fn send(&self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match rustix::io::write(&self.0, bytes) {
                Ok(written) => bytes = bytes.get(written..).unwrap_or_default(),
                Err(Errno::INTR) => {}
                Err(_) => break,
            }
        }
    }
}
