//! Records which watched instructions ran. Each has a breakpoint, which is removed at the first
//! hit, so that code runs at full speed.

use rigless::emulator::Processor;
use std::collections::{BTreeMap, BTreeSet};

#[derive(Debug, Default)]
pub(super) struct ExecutionRecorder {
    pending: BTreeSet<u64>,
    /// Executed instructions by address. The value is true if one ran in a control step.
    executed: BTreeMap<u32, bool>,
    in_control_step: bool,
    had_control_step: bool,
}

impl ExecutionRecorder {
    pub(super) fn watch(&mut self, addresses: &BTreeSet<u32>, core: &mut dyn Processor) {
        self.pending.iter().for_each(|&address| core.remove_breakpoint(address));
        *self = Self { pending: addresses.iter().map(|&address| u64::from(address)).collect(), ..Self::default() };
        self.pending.retain(|&address| core.add_breakpoint(address));
    }

    /// Before the first control step, watches instructions again that ran during the start, because
    /// they may also run in a control step.
    pub(super) fn set_control_step(&mut self, in_control_step: bool, core: &mut dyn Processor) {
        self.in_control_step = in_control_step;
        if in_control_step && !std::mem::replace(&mut self.had_control_step, true) {
            let again = self.executed.keys().map(|&address| u64::from(address));
            self.pending.extend(again.filter(|&address| core.add_breakpoint(address)));
        }
    }

    pub(super) fn record(&mut self, address: u64, core: &mut dyn Processor) {
        if self.pending.remove(&address)
            && let Ok(recorded) = u32::try_from(address)
        {
            core.remove_breakpoint(address);
            *self.executed.entry(recorded).or_default() |= self.in_control_step;
        }
    }

    pub(super) fn executed_instructions(&self) -> &BTreeMap<u32, bool> {
        &self.executed
    }
}
