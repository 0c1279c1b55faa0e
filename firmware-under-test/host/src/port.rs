//! The line: a terminal in raw mode that never blocks.

use crate::Failure;
use crate::arguments::Arguments;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, tcgetattr, tcsetattr};
use std::time::Duration;

/// See the module.
pub(crate) struct Port(OwnedFd);

/// What the line brought.
pub(crate) enum Brought<'a> {
    Bytes(&'a [u8]),
    Nothing,
    HungUp,
}

impl Port {
    /// Opens the port that `arguments` name.
    pub(crate) fn open(arguments: &Arguments) -> Result<Self, Failure> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let refused = |error: Errno| Failure::Open { port: arguments.port.clone(), error: error.into() };
        let file = rustix::fs::open(&arguments.port, flags, Mode::empty()).map_err(refused)?;
        let settings = tcgetattr(&file).and_then(|mut settings| {
            settings.make_raw();
            settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
            settings.control_modes &= !(ControlModes::CSTOPB | ControlModes::CRTSCTS);
            settings.set_speed(arguments.baud)?;
            tcsetattr(&file, OptionalActions::Now, &settings)
        });
        settings.map_err(|error| {
            let (port, baud) = (arguments.port.clone(), arguments.baud);
            Failure::Settings { port, baud, error: error.into() }
        })?;
        Ok(Self(file))
    }

    /// Waits for bytes, at most for `patience`.
    pub(crate) fn receive<'a>(&self, buffer: &'a mut [u8], patience: Duration) -> Brought<'a> {
        let timeout = Timespec {
            tv_sec: i64::try_from(patience.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: patience.subsec_nanos().into(),
        };
        // Whatever ends the wait, the read says what there is.
        let _ = poll(&mut [PollFd::new(&self.0, PollFlags::IN)], Some(&timeout));
        match rustix::io::read(&self.0, &mut *buffer) {
            Ok(0) => Brought::HungUp,
            Ok(count) => Brought::Bytes(buffer.get(..count).unwrap_or_default()),
            Err(Errno::AGAIN | Errno::INTR) => Brought::Nothing,
            Err(_) => Brought::HungUp,
        }
    }

    /// Sends what the line takes at once; a line that is full loses the rest, as a UART would.
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
