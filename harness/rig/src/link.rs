//! Defines the interface of every rig, which transports bytes to a target and back.

use crate::chip_fault::{ChipFaultError, ChipFaultPlan};
use crate::target_error::TargetError;
use std::ops::DerefMut;
use std::time::{Duration, Instant};

pub type BoxedLink = Box<dyn Link>;

#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The controller is a program that ended by itself. Contains its exit status or signal.
    #[error("the program of the controller ended before 0 V was confirmed: {0}")]
    Ended(String),
    #[error("{0}")]
    Target(Box<TargetError>),
}

/// Clock and reliability of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LinkKind {
    /// The target runs in simulated time. No byte is lost.
    #[default]
    Simulated,
    /// The target runs in wall time. No byte is lost.
    Lossless,
    /// The target runs in wall time. Noise on the line may destroy bytes.
    Lossy,
}

/// A line on which one thread sends and receives in real time.
pub trait RealTimeLine: Send {
    /// Call it before a trial on the thread of the trial loop, because a thread that reads the line
    /// inherits the scheduling class.
    fn start(&mut self) -> Result<(), LinkError> {
        Ok(())
    }

    /// Returns at once. Drops the bytes that a full line does not accept.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Appends bytes that arrive by `until` and returns their arrival; `None` on time-out. Takes
    /// bytes that already wait even if `until` is past. Does not allocate if `bytes` has capacity.
    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError>;
}

/// Access to an emulated chip: measurements, pins, RTT text and faults.
pub trait Chip {
    /// Instructions that the chip ran from the first bit of the last [`Link::exchange`] to the last
    /// bit of its answer; `None` without an answer.
    fn instruction_count(&self) -> Option<u64>;

    /// Time that the chip computed for the last [`Link::exchange`] with an answer, without the
    /// transmission.
    fn computing_time(&self) -> Option<Duration>;

    /// RTT text of the firmware in this trial; `None` without text or without an RTT block.
    fn firmware_output(&self) -> Option<String>;

    /// True if the pin PB0, which enables the amplifier, is high. `None` if it was not high yet in
    /// this trial.
    fn amplifier_enabled(&mut self) -> Option<bool>;

    /// Sets the faults that act from the next restart on. Call it before the trial's configuration.
    fn set_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError>;
}

/// In all methods, `now` is the time since the start of the trial.
pub trait Link: Send {
    /// Sends `bytes` and appends the answer, up to its end or the time-out; a missing answer is no
    /// error. Returns the time from the request to the end of the answer; zero without an answer
    /// and on the hosted rig.
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError>;

    /// Advances the target's time to `now` and appends the bytes that the target sends until then.
    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError>;

    fn kind(&self) -> LinkKind {
        LinkKind::Simulated
    }

    /// Restarts the target and sets trial time to zero. Returns false if the link cannot.
    fn restart(&mut self) -> Result<bool, LinkError> {
        Ok(false)
    }

    /// Starts another trial without a restart of the target. The next `now` counts from zero.
    fn continue_trial(&mut self) {}

    /// Access to the chip, if the link emulates it.
    fn chip(&mut self) -> Option<&mut dyn Chip> {
        None
    }

    /// Line for a trial's samples in real time, if the link has one. Other messages may use
    /// [`Link::exchange`].
    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        None
    }
}

impl<P: DerefMut<Target: Link> + Send> Link for P {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        (**self).exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        (**self).advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        (**self).kind()
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        (**self).restart()
    }

    fn continue_trial(&mut self) {
        (**self).continue_trial();
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        (**self).chip()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        (**self).real_time_line()
    }
}
