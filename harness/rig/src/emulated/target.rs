//! Defines what the link needs of an emulated board. Hides the emulator.

use crate::symbols::CodeLocation;
use crate::target_error::TargetError;
use std::fmt;

/// A byte from the target, with the end of its stop bit in ns since power-on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ReceivedByte {
    pub(super) byte: u8,
    pub(super) at_ns: u64,
}

/// A board with an image in its flash, in virtual time. Equal calls give equal results, bit for bit.
pub(super) trait Target: Send + fmt::Debug {
    /// Switches the supply off and on: time zero, RAM undefined, line idle.
    fn power_on(&mut self) -> Result<(), TargetError>;

    /// Notes that the firmware has started and will hardly use further peripherals. Affects only the speed.
    fn mark_booted(&mut self);

    /// Virtual time since power-on.
    fn now_ns(&self) -> u64;

    /// Instructions executed since power-on.
    fn instructions(&self) -> u64;

    /// Sends bytes from now on, at the target's baud rate.
    fn send(&mut self, bytes: &[u8]);

    /// Runs to `until_ns`, or to the end of the next frame from the target. True at the end of a frame. Always
    /// returns: reports time that does not advance as an error.
    fn run(&mut self, until_ns: u64) -> Result<bool, TargetError>;

    /// Moves the bytes received since the last call.
    fn take_received(&mut self, into: &mut Vec<ReceivedByte>);

    /// The processor's place and the used peripherals, for the report of a silent target.
    fn status(&self) -> TargetStatus;

    /// Largest stack use since power-on, bytes, if the image defines `_stack_end`.
    fn stack_used(&self) -> Option<u32>;
}

/// See [`Target::status`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TargetStatus {
    pub(super) place: CodeLocation,
    pub(super) instances: Vec<&'static str>,
}
