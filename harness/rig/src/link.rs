//! Bytes to a target and back.

use crate::emulated::TargetFault;
use std::time::{Duration, Instant};

/// Why bytes no longer pass.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side is gone: process ended, cable pulled, port closed.
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The firmware trapped, on an emulated board or before the eyes of a debug probe; or it fell silent or left what the emulator knows.
    #[error("{0}")]
    Target(Box<TargetFault>),
}

/// A line in real time. One thread sends and listens; nothing here waits for an answer by itself.
pub trait Line: Send {
    /// Puts `bytes` on the line and returns at once. A line that is full drops what does not fit: silence will show it.
    ///
    /// # Errors
    /// [`LinkError`] where the line is dead.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Waits until something arrives or `until` has passed, appends it to `bytes` and returns the instant at which it was there; `None` where nothing came.
    /// What is there already is taken even where `until` is over. Never allocates once `bytes` has room.
    ///
    /// # Errors
    /// [`LinkError`] where the line is dead.
    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError>;
}

/// A line to a target. Instants are counted from the start of the trial.
///
/// Faults are links around links; rigs are links at the bottom.
pub trait Link: Send {
    /// Puts `bytes` on the line at `now` and appends to `answer` what comes back, up to the end of the answer or until the link's patience, which is
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

    /// The same line in real time, where it can be used so. Between [`Link::restart`] and the next one a caller uses either this or
    /// [`Link::exchange`] and [`Link::pass`] for samples; the handshake, the configuration and the end may be exchanged in both cases.
    fn line(&mut self) -> Option<&mut dyn Line> {
        None
    }
}

impl<L: Link + ?Sized> Link for &mut L {
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

    fn line(&mut self) -> Option<&mut dyn Line> {
        (**self).line()
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

    fn line(&mut self) -> Option<&mut dyn Line> {
        (**self).line()
    }
}
