//! Defines the interface of every rig: bytes to a target and back.

use crate::chip_fault::{ChipFaultError, ChipFaultPlan};
use crate::target_error::TargetError;
use std::ops::DerefMut;
use std::time::{Duration, Instant};

pub type BoxedLink = Box<dyn Link>;

#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The firmware crashed, or the emulator cannot go on with it.
    #[error("{0}")]
    Target(Box<TargetError>),
}

/// One thread sends and receives.
pub trait RealTimeLine: Send {
    /// Call it before a trial, on the thread of its loop: a thread that reads the line inherits the scheduling class.
    fn start(&mut self) -> Result<(), LinkError> {
        Ok(())
    }

    /// Returns at once. Drops what a full line does not take.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Appends bytes that arrive by `until` and returns their arrival; `None` on time-out. Takes
    /// waiting bytes even if `until` is past. Does not allocate if `bytes` has capacity.
    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError>;
}

/// The fault injector wraps another link. Instants count from the trial's start.
pub trait Link: Send {
    /// Sends `bytes` and appends the answer, up to its end or the time-out; silence is no error.
    /// Returns the delay on the target's clock; zero for a transparent link.
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError>;

    /// Advances the target's time to `now` and appends the bytes that it sends until then.
    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError>;

    /// Restarts the target as after power-on, and the trial's time. False if the link cannot.
    fn restart(&mut self) -> Result<bool, LinkError> {
        Ok(false)
    }

    /// Starts the time of another trial without a restart: the next `now` is zero again.
    fn continue_trial(&mut self) {}

    /// Instructions from the first bit of the last [`Link::exchange`] to the last bit of its answer.
    fn instruction_count(&self) -> Option<u64> {
        None
    }

    /// Text that the firmware wrote for people in this trial. `None` without any, or if the rig does not see it.
    fn firmware_output(&self) -> Option<String> {
        None
    }

    /// Applies to the next trial, from its restart on. Call it before the trial's configuration.
    fn set_chip_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError> {
        if plan.faults.is_empty() { Ok(()) } else { Err(ChipFaultError::Unsupported) }
    }

    /// Level of the amplifier enable (PB0). `None` if the rig does not see it, or the firmware never set it.
    fn amplifier_enabled(&mut self) -> Option<bool> {
        None
    }

    /// Samples of a trial go either over this or over [`Link::exchange`]; handshake, configuration
    /// and `Safe` may always use the latter.
    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        None
    }
}

/// A pointer to a link is a link.
impl<P: DerefMut<Target: Link> + Send> Link for P {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        (**self).exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        (**self).advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        (**self).restart()
    }

    fn continue_trial(&mut self) {
        (**self).continue_trial();
    }

    fn instruction_count(&self) -> Option<u64> {
        (**self).instruction_count()
    }

    fn firmware_output(&self) -> Option<String> {
        (**self).firmware_output()
    }

    fn set_chip_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError> {
        (**self).set_chip_faults(plan)
    }

    fn amplifier_enabled(&mut self) -> Option<bool> {
        (**self).amplifier_enabled()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        (**self).real_time_line()
    }
}
