//! Opens pseudo-terminals, for a program or for a controller that is started by hand.

use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::port::Port;
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::io;
use std::time::Duration;

/// Returns the bench's end in raw mode, the controller's end and its path.
pub(crate) fn open_pseudo_terminal() -> rustix::io::Result<(Port<OwnedFd>, OwnedFd, String)> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let name = ptsname(&master, Vec::new())?;
    // The bench opens this end itself, because the kernel reports a hang-up if the other end of a
    // line was never opened.
    let slave = rustix::fs::open(&name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut settings = tcgetattr(&slave)?;
    settings.make_raw();
    tcsetattr(&slave, OptionalActions::Now, &settings)?;
    Ok((Port::from_fd(master)?, slave, name.to_string_lossy().into_owned()))
}

/// Link to a controller that the user starts. Before that, the line is silent, not lost.
#[derive(Debug)]
pub struct PtyLink {
    port: Port<OwnedFd>,
    path: String,
    _other_end: OwnedFd,
}

impl PtyLink {
    pub fn open() -> io::Result<Self> {
        let (port, other_end, path) = open_pseudo_terminal()?;
        Ok(Self { port, path, _other_end: other_end })
    }

    pub fn path(&self) -> &str {
        &self.path
    }
}

impl Link for PtyLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.port.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.port.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossless
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(&mut self.port)
    }
}
