//! What the link needs of an emulated board; the emulator itself stays behind this.

use super::fault::TargetFault;
use std::fmt;

/// A byte from the target and the instant at which its stop bit ended, ns since power-on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Heard {
    pub(super) byte: u8,
    pub(super) at_ns: u64,
}

/// One board with one image in its flash, in virtual time. Same calls, same answers, bit for bit.
pub(super) trait Target: Send + fmt::Debug {
    /// Takes the supply away and gives it back: time zero, memory unknown, nothing on the line.
    fn power_on(&mut self) -> Result<(), TargetFault>;

    /// The firmware has come up and will hardly use what it has not used so far: a hint, without effect on anything but speed.
    fn came_up(&mut self);

    /// Virtual time since power-on.
    fn now_ns(&self) -> u64;

    /// Instructions executed since power-on.
    fn instructions(&self) -> u64;

    /// Puts bytes on the line from now on, one after the other at the target's own baud rate.
    fn send(&mut self, bytes: &[u8]);

    /// Runs to `until_ns`, or to the next zero byte that ends a frame from the target, whichever comes first; a frame's end is told by `true`.
    ///
    /// Bounded: it returns when the time is over, and finds out where that no longer passes.
    fn run(&mut self, until_ns: u64) -> Result<bool, TargetFault>;

    /// Hands over what was heard since the last call.
    fn take_heard(&mut self, into: &mut Vec<Heard>);

    /// Where the processor is, and what the image has set up of the part, for somebody who wonders why it is silent.
    fn whereabouts(&self) -> Whereabouts;

    /// Most bytes that the stack ever held since power-on, where the image says where its stack is.
    fn stack_used(&self) -> Option<u32>;
}

/// See [`Target::whereabouts`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Whereabouts {
    pub(super) place: crate::symbols::Place,
    pub(super) instances: Vec<&'static str>,
}
