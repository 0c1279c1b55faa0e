//! Connects to a board on a debug probe: `--rig
//! probe:CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]`. Flashes and restarts the board,
//! then opens an [`RttLink`] or a [`PortLink`]. Each call runs on the probe's thread and has a
//! time-out. The bench enables no vector catch (a halt at the entry of a fault handler) and does
//! not stop the chip's watchdog, because a halted processor cannot take the drive to 0 V.

mod attached_board;
mod board;
mod error;
mod image;
mod links;

pub use attached_board::{AttachedBoard, Timeouts};
pub use board::{ChipId, FlashOutcome, ProbeSpec};
pub use error::ProbeError;
pub use image::FlashImage;
pub use links::{PortLink, RttLink, ShutdownResult};
pub use probe_rs::probe::list::Lister;

use crate::emulated::read_elf;
use crate::factory::BUILT_IN_IMAGE;
use crate::link::BoxedLink;
use crate::serial_port::SerialLink;
use board::Board;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tracing::info;

/// Path and baud rate (bits per second).
pub type SerialPort = (PathBuf, u32);

#[derive(Debug, Clone)]
pub struct ProbeSetup {
    spec: ProbeSpec,
    image: Arc<FlashImage>,
    port: Option<SerialPort>,
}

impl ProbeSetup {
    /// Uses RTT if `port` is `None`. Fails for an unknown chip, for an ELF without content, or if
    /// RTT is needed and the image has none.
    pub fn new(spec: ProbeSpec, elf: &[u8], port: Option<SerialPort>) -> Result<Self, ProbeError> {
        Board::resolve_target(&spec)?;
        let image = Arc::new(FlashImage::parse(elf)?);
        if port.is_none() && image.rtt().is_none() {
            return Err(ProbeError::NoRtt);
        }
        Ok(Self { spec, image, port })
    }

    /// `board` is `CHIP[@VID:PID[:SERIAL]]`. Uses the built-in image if `elf` is `None`.
    pub(crate) fn from_arguments(
        board: &str,
        elf: Option<&Path>,
        port: Option<SerialPort>,
    ) -> Result<Self, ProbeError> {
        match elf {
            None => Self::new(board.parse()?, BUILT_IN_IMAGE, port),
            Some(path) => {
                let elf = read_elf(path).map_err(|error| ProbeError::Read { path: path.to_owned(), error })?;
                Self::new(board.parse()?, &elf, port)
            }
        }
    }

    pub fn connect(
        self,
        list: impl FnOnce() -> Lister + Send + 'static,
        timeouts: Timeouts,
    ) -> Result<BoxedLink, ProbeError> {
        match self.port.clone() {
            None => Ok(Box::new(self.connect_rtt(list, timeouts)?)),
            Some(port) => Ok(Box::new(self.connect_port(&port, list, timeouts)?)),
        }
    }

    pub fn connect_rtt(
        self,
        list: impl FnOnce() -> Lister + Send + 'static,
        timeouts: Timeouts,
    ) -> Result<RttLink, ProbeError> {
        RttLink::open(self.start_board(list, timeouts)?, self.image)
    }

    fn connect_port(
        self,
        (path, baud): &SerialPort,
        list: impl FnOnce() -> Lister + Send + 'static,
        timeouts: Timeouts,
    ) -> Result<PortLink, ProbeError> {
        // The port is opened first, because a board without its port must not be reset or written.
        let serial = SerialLink::open(path, *baud)?;
        let board = self.start_board(list, timeouts)?;
        PortLink::open(serial, path, board, self.image)
    }

    fn start_board(
        &self,
        list: impl FnOnce() -> Lister + Send + 'static,
        timeouts: Timeouts,
    ) -> Result<AttachedBoard, ProbeError> {
        let mut board = AttachedBoard::attach(&self.spec, list, timeouts)?;
        info!(chip = board.chip().name, idcode = board.chip().idcode, probe = board.chip().probe, "board found");
        board.flash(&self.image)?;
        board.restart(&self.image)?;
        Ok(board)
    }
}
