//! A board on a debug probe: `--rig probe:CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]`.
//!
//! ```text
//!   Setup ──▶ Attached (probe found, chip checked) ──▶ flash ──▶ restart ──▶ RttLink, or PortLink: a serial port and the probe beside it
//!                     │ every call runs on a thread of its own and is waited for within a stated time
//!                     └──▶ fault(): registers, symbols and backtrace        end(): 0 V, reset, probe released
//! ```
//!
//! * [`setup`]: what was asked for, checked, and from there to a line.
//! * [`spec`]: which chip and which probe. `choose`: the one probe meant, or why there is none.
//! * `worker`: a thread that may hang without the bench hanging. `board`: what is done there with probe-rs.
//! * [`image`]: what an ELF puts where. `unwind`: callers of an address.
//! * [`fault`]: a trap, read from the processor. [`link`]: the wire protocol over RTT. `port`: over the board's serial port.
//!
//! Nothing here enables a vector catch or stops the chip's
//! watchdog: a processor that is stopped at the entry of its fault handler cannot take the drive to 0 V.

mod board;
mod choose;
mod error;
pub mod fault;
mod handle;
pub mod image;
pub mod link;
mod port;
pub mod setup;
pub mod spec;
mod unwind;
mod worker;

pub use board::{ChipId, Flashed};
pub use error::ProbeError;
pub use fault::Fault;
pub use handle::Attached;
pub use image::Image;
pub use link::{Ending, RttLink};
pub use port::PortLink;
/// What lists probes: `Lister::new` for those on USB.
pub use probe_rs::probe::list::Lister;
pub use setup::Setup;
pub use spec::ProbeSpec;
pub use unwind::StackedFrame;

use std::time::Duration;

/// How long the bench waits for what. Nothing is waited for without an end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patience {
    /// Finding the probe, waking the debug port, reading the chip's identity.
    pub attach: Duration,
    /// Comparing, erasing, programming and comparing again.
    pub flash: Duration,
    /// A reset up to running firmware.
    pub reset: Duration,
    /// The firmware's RTT control block after a reset.
    pub rtt: Duration,
    /// The firmware's first answer on its serial port after a reset.
    pub introduction: Duration,
    /// The answer to one message over RTT. Silence beyond it is no error.
    pub exchange: Duration,
    /// Reading registers and stack after a trap.
    pub fault: Duration,
    /// What a call may take beyond its own time before the probe is given up as hung.
    pub grace: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            attach: Duration::from_secs(20),
            flash: Duration::from_mins(2),
            reset: Duration::from_secs(3),
            rtt: Duration::from_secs(2),
            introduction: Duration::from_secs(2),
            exchange: Duration::from_millis(100),
            fault: Duration::from_secs(2),
            grace: Duration::from_secs(2),
        }
    }
}
