//! Bounds the waits for a debug probe and its board.

use std::time::Duration;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    pub attach: Duration,
    /// Includes the comparisons of the flash content before and after the write.
    pub flash: Duration,
    pub reset: Duration,
    /// Longest wait for the RTT control block after a reset.
    pub rtt: Duration,
    /// Longest wait for the first answer on the serial port after a reset.
    pub handshake: Duration,
    /// Longest wait for an answer. A missing answer is no error.
    pub exchange: Duration,
    pub crash: Duration,
    /// Added to the time-out of a call. If the call has not ended then, the probe counts as hung.
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
