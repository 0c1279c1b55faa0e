//! Bounds the waits for a debug probe and its board.

use std::time::Duration;

/// Time-outs of the calls to a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    /// Finding the probe, waking the debug port, reading the chip's identity.
    pub attach: Duration,
    /// Comparing, erasing, programming and comparing again.
    pub flash: Duration,
    /// A reset up to running firmware.
    pub reset: Duration,
    /// The firmware's RTT control block after a reset.
    pub rtt: Duration,
    /// The firmware's first answer on its serial port after a reset.
    pub handshake: Duration,
    /// The answer to one message over RTT. Silence beyond it is no error.
    pub exchange: Duration,
    /// Reading registers and stack after a trap.
    pub crash: Duration,
    /// Additional time of each call before the probe counts as hung.
    pub grace: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            attach: Duration::from_secs(20),
            flash: Duration::from_mins(2),
            reset: Duration::from_secs(3),
            rtt: Duration::from_secs(2),
            handshake: Duration::from_secs(2),
            exchange: Duration::from_millis(100),
            crash: Duration::from_secs(2),
            grace: Duration::from_secs(2),
        }
    }
}
