//! Bytes to a target and back.

use crate::emulated::TargetFault;
use std::time::Duration;

/// Why bytes no longer pass.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side is gone: process ended, cable pulled, port closed.
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The firmware on an emulated board trapped, fell silent or left what the emulator knows.
    #[error("{0}")]
    Target(Box<TargetFault>),
}

/// A line to a target. Instants are counted from the start of the trial.
///
/// Faults are links around links; rigs are links at the bottom.
pub trait Link: Send {
    /// Puts `bytes` on the line at `now` and appends to `answer` what comes back, up to the end of the first frame or until the link's patience, which is
    /// bounded, is over. Returns how long the target took on its own clock, zero where the link is transparent.
    ///
    /// # Errors
    /// [`LinkError`] where the line is dead. Silence is not an error: the answer stays empty.
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError>;

    /// Lets the target's time pass up to `now` without bytes for it and appends what it says of its own accord.
    ///
    /// # Errors
    /// [`LinkError`] where the line is dead.
    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError>;

    /// Brings the target back to its state after power-on, where the link can; the instants of the next trial count from zero again. True where it did.
    ///
    /// # Errors
    /// [`LinkError`] where the target does not come back.
    fn restart(&mut self) -> Result<bool, LinkError> {
        Ok(false)
    }

    /// Instructions that the target executed from the first bit of the last [`Link::exchange`] to the last bit of its answer, where the link can count them.
    fn cost(&self) -> Option<u64> {
        None
    }
}

impl<L: Link + ?Sized> Link for Box<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        (**self).exchange(now, bytes, answer)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        (**self).pass(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        (**self).restart()
    }

    fn cost(&self) -> Option<u64> {
        (**self).cost()
    }
}
