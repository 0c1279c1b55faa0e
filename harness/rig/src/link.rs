//! Defines the interface of every rig: bytes to a target and back.

use crate::target_error::TargetError;
use std::time::{Duration, Instant};

/// A link of any kind.
pub type BoxedLink = Box<dyn Link>;

/// Why a link no longer works.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side is gone: process ended, cable unplugged, port closed.
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The firmware crashed, or the emulator cannot go on with it.
    #[error("{0}")]
    Target(Box<TargetError>),
}

/// A link in real time. One thread sends and receives.
pub trait RealTimeLine: Send {
    /// Sends `bytes` and returns at once. Drops what a full line does not take.
    ///
    /// # Errors
    /// [`LinkError`] if the link is lost.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Waits for bytes until `until`, appends them to `bytes` and returns their instant of arrival;
    /// `None` on time-out. Takes waiting bytes even if `until` is past. Does not allocate if `bytes`
    /// has capacity.
    ///
    /// # Errors
    /// [`LinkError`] if the link is lost.
    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError>;
}

/// A link to a target. Instants count from the start of the trial.
///
/// A rig is the innermost link; the fault injector is a link around a link.
pub trait Link: Send {
    /// Sends `bytes` at `now` and appends the answer to `answer`, up to the answer's end or the link's
    /// time-out. Returns the delay on the target's clock; zero for a transparent link.
    ///
    /// # Errors
    /// [`LinkError`] if the link is lost. Silence is no error: the answer stays empty.
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError>;

    /// Advances the target's time to `now` and appends the bytes that it sends meanwhile.
    ///
    /// # Errors
    /// [`LinkError`] if the link is lost.
    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError>;

    /// Restarts the target as after power-on, and the trial's time at zero. Returns false if the link
    /// cannot do that.
    ///
    /// # Errors
    /// [`LinkError`] if the target does not come back.
    fn restart(&mut self) -> Result<bool, LinkError> {
        Ok(false)
    }

    /// Instructions executed from the first bit of the last [`Link::exchange`] to the last bit of its
    /// answer, if the link counts them.
    fn instruction_count(&self) -> Option<u64> {
        None
    }

    /// The same link in real time, if it supports that. Within a trial, samples go either over this or
    /// over [`Link::exchange`]; handshake, configuration and `Safe` may always use the latter.
    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        None
    }
}

macro_rules! forward_link {
    ($type:ty) => {
        impl<L: Link + ?Sized> Link for $type {
            fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
                (**self).exchange(now, bytes, answer)
            }

            fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
                (**self).advance_to(now, received)
            }

            fn restart(&mut self) -> Result<bool, LinkError> {
                (**self).restart()
            }

            fn instruction_count(&self) -> Option<u64> {
                (**self).instruction_count()
            }

            fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
                (**self).real_time_line()
            }
        }
    };
}

forward_link!(&mut L);
forward_link!(Box<L>);
