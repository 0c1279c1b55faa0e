//! Stores a debugger's breakpoints and its requests to step or to stop the chip.

use gdbstub::stub::SingleThreadStopReason;
use rigless::emulator::Processor;
use std::collections::BTreeSet;

pub(super) type DebugStop = SingleThreadStopReason<u32>;

#[derive(Debug, Default)]
pub(super) struct DebugControl {
    breakpoints: BTreeSet<u64>,
    pub(super) single_step: bool,
    pub(super) stop: Option<DebugStop>,
}

impl DebugControl {
    pub(super) fn has_breakpoint(&self, address: u64) -> bool {
        self.breakpoints.contains(&address)
    }

    pub(super) fn add(&mut self, address: u64, core: &mut dyn Processor) -> bool {
        self.breakpoints.contains(&address) || core.add_breakpoint(address) && self.breakpoints.insert(address)
    }

    pub(super) fn remove(&mut self, address: u64, core: &mut dyn Processor) -> bool {
        let removed = self.breakpoints.remove(&address);
        if removed {
            core.remove_breakpoint(address);
        }
        removed
    }

    pub(super) fn end(&mut self, core: &mut dyn Processor) {
        for address in std::mem::take(&mut self.breakpoints) {
            core.remove_breakpoint(address);
        }
        *self = Self::default();
    }
}
