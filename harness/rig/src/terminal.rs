//! A pseudo-terminal that waits for a controller: somebody else starts it and gives it the terminal's path.

use crate::exec::pseudo_terminal;
use crate::link::{Line, Link, LinkError};
use crate::port::Port;
use rustix::fd::OwnedFd;
use std::io;
use std::time::Duration;

/// See the module. Controllers may come and go: nobody at the other end is silence, not a line that hung up.
#[derive(Debug)]
pub struct Terminal {
    port: Port<OwnedFd>,
    path: String,
    /// Keeps the line up between two controllers.
    _other_end: OwnedFd,
}

impl Terminal {
    /// A new one, in raw mode.
    ///
    /// # Errors
    /// What the system says where there is none to be had.
    pub fn open() -> io::Result<Self> {
        let (port, other_end, path) = pseudo_terminal()?;
        Ok(Self { port, path, _other_end: other_end })
    }

    /// What a controller opens as its serial port.
    pub fn path(&self) -> &str {
        &self.path
    }
}

impl Link for Terminal {
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
