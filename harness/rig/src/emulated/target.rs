//! Defines what the link needs of an emulated board; hides the emulator.

use crate::chip_fault::{ChipFaultError, ChipFaultKind};
use crate::symbols::CodeLocation;
use crate::target_error::TargetError;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// `end_ns`: end of the stop bit since power-on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ReceivedByte {
    pub(super) byte: u8,
    pub(super) at_ns: u64,
}

/// Virtual time. Equal calls give equal results, bit for bit.
pub(super) trait Target: Send + fmt::Debug {
    /// Switches the supply off and on: time zero, RAM undefined, line idle.
    fn power_on(&mut self) -> Result<(), TargetError>;

    /// The firmware has started and will hardly use further peripherals. Affects only the speed.
    fn mark_booted(&mut self);

    fn now_ns(&self) -> u64;

    fn instructions(&self) -> u64;

    fn send(&mut self, bytes: &[u8]);

    /// True at the end of a frame from the target. Fails if time does not advance, so it always
    /// returns.
    fn run(&mut self, until_ns: u64) -> Result<bool, TargetError>;

    fn take_received(&mut self, into: &mut Vec<ReceivedByte>);

    /// Starts a new recording of the instructions at `addresses`.
    fn watch(&mut self, addresses: &BTreeSet<u32>);

    fn set_control_step(&mut self, in_control_step: bool);

    /// Watched instructions that ran; true if within a control step.
    fn executed_instructions(&self) -> &BTreeMap<u32, bool>;

    /// Changes memory, also flash. False without memory there.
    fn patch(&mut self, address: u32, bytes: &[u8]) -> bool;

    /// Fails if the image or the board lacks what the fault needs.
    fn check_fault(&self, fault: &ChipFaultKind) -> Result<(), ChipFaultError>;

    /// Applies the fault now. From here on the firmware handles traps and resets itself, until power-on.
    fn inject(&mut self, fault: &ChipFaultKind) -> Result<(), TargetError>;

    fn amplifier_enabled(&self) -> bool;

    /// Text that the firmware wrote since power-on or [`Target::clear_output`].
    fn firmware_output(&self) -> Option<String>;

    fn clear_output(&mut self);

    fn status(&self) -> TargetStatus;

    /// In bytes since power-on, if the image defines `_stack_end`.
    fn stack_used(&self) -> Option<u32>;
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TargetStatus {
    pub(super) place: CodeLocation,
    pub(super) instances: Vec<&'static str>,
}
