//! From what a user wrote to a line. What can be checked without the board is checked before anything of it is opened.

use super::board::Board;
use super::error::ProbeError;
use super::handle::Attached;
use super::image::Image;
use super::link::RttLink;
use super::port::PortLink;
use super::spec::ProbeSpec;
use super::{Lister, Patience};
use crate::connect::{AnyLink, ConnectError};
use crate::emulated::{BUILT_IN, read_elf};
use crate::serial::{DEFAULT_BAUD, Serial};
use crate::spec::RigSpec;
use std::path::PathBuf;
use std::sync::Arc;
use tracing::info;

/// A serial port and its bits per second.
pub type Port = (PathBuf, u32);

/// Which board is to run which firmware, and what it talks over.
#[derive(Debug, Clone)]
pub struct Setup {
    spec: ProbeSpec,
    image: Arc<Image>,
    port: Option<Port>,
}

impl Setup {
    /// `elf` on the board that `spec` means, talked to over `port`, or over RTT where there is none.
    ///
    /// # Errors
    /// [`ProbeError`] where the chip is unknown, the ELF cannot be flashed, or it has neither a port nor RTT to talk over.
    pub fn new(spec: ProbeSpec, elf: &[u8], port: Option<Port>) -> Result<Self, ProbeError> {
        Board::describe(&spec)?;
        let image = Arc::new(Image::parse(elf)?);
        if port.is_none() && image.rtt().is_none() {
            return Err(ProbeError::NoRtt);
        }
        Ok(Self { spec, image, port })
    }

    /// What `rig` asks for; the image that came with the bench where it names none.
    ///
    /// # Errors
    /// As [`Setup::new`]; [`ProbeError::Read`] where the ELF cannot be read, [`ProbeError::Spec`] where `rig` is not on a probe.
    pub fn of(rig: &RigSpec) -> Result<Self, ProbeError> {
        let RigSpec::Probe { board, elf, port, baud } = rig else {
            return Err(ProbeError::Spec { text: rig.to_string() });
        };
        let port = port.as_ref().map(|port| (port.into(), baud.unwrap_or(DEFAULT_BAUD)));
        match elf {
            None => Self::new(board.parse()?, BUILT_IN, port),
            Some(path) => {
                let elf = read_elf(path).map_err(|error| ProbeError::Read { path: path.clone(), error })?;
                Self::new(board.parse()?, &elf, port)
            }
        }
    }

    /// A line to the controller, over whatever it talks: attach, flash where the image is not there yet, reset, run.
    ///
    /// # Errors
    /// [`ConnectError`], of the probe or of the serial port.
    pub fn connect(
        self,
        list: impl FnOnce() -> Lister + Send + 'static,
        patience: Patience,
    ) -> Result<AnyLink, ConnectError> {
        match self.port.clone() {
            None => Ok(Box::new(self.over_rtt(list, patience)?)),
            Some(port) => Ok(Box::new(self.over_port(&port, list, patience)?)),
        }
    }

    /// The same over RTT.
    ///
    /// # Errors
    /// [`ProbeError`]; [`ProbeError::NoRtt`] where the firmware has none.
    pub fn over_rtt(
        self,
        list: impl FnOnce() -> Lister + Send + 'static,
        patience: Patience,
    ) -> Result<RttLink, ProbeError> {
        RttLink::open(self.start(list, patience)?, self.image)
    }

    fn over_port(
        self,
        (path, baud): &Port,
        list: impl FnOnce() -> Lister + Send + 'static,
        patience: Patience,
    ) -> Result<PortLink, ConnectError> {
        // First, because a port that is not there must cost the board neither a reset nor a write.
        let serial = Serial::open(path, *baud)?;
        let board = self.start(list, patience)?;
        Ok(PortLink::open(serial, path, board, self.image)?)
    }

    fn start(
        &self,
        list: impl FnOnce() -> Lister + Send + 'static,
        patience: Patience,
    ) -> Result<Attached, ProbeError> {
        let mut board = Attached::attach(&self.spec, list, patience)?;
        info!(chip = board.chip().name, idcode = board.chip().idcode, probe = board.chip().probe, "board found");
        board.flash(&self.image)?;
        board.restart(&self.image)?;
        Ok(board)
    }
}
