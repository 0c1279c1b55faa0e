//! Connects to a board on a debug probe: `--rig
//! probe:CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]`. Flashes and restarts the board,
//! then opens an [`RttLink`] or a [`PortLink`]. Each call runs on the probe's thread and has a
//! time-out. The bench enables no vector catch (a halt at the entry of a fault handler) and does
//! not stop the chip's watchdog, because a halted processor cannot take the drive to 0 V.

mod attached_board;
mod board;
mod crash;
mod error;
pub mod image;
mod port_link;
mod probe_thread;
mod rtt_channels;
pub mod rtt_link;
mod selection;
pub mod setup;
pub mod spec;
mod timeouts;

pub use attached_board::AttachedBoard;
pub use board::{ChipId, FlashOutcome};
pub use error::ProbeError;
pub use image::Image;
pub use port_link::PortLink;
pub use probe_rs::probe::list::Lister;
pub use rtt_link::{RttLink, ShutdownResult};
pub use setup::ProbeSetup;
pub use spec::ProbeSpec;
pub use timeouts::Timeouts;
