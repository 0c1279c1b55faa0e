//! Applies faults to the emulated chip: flipped bits, resets, a hang, stuck registers.

use super::machine::{Machine, emulator_error};
use crate::chip_fault::{ChipFaultError, ChipFaultKind};
use crate::symbols::Symbols;
use crate::target_error::TargetError;
use rigless::time::VirtualNanos;

/// Address and code of an endless loop (`cpsid i; b .`) in the last bytes of flash, which are
/// rarely used.
const HANG: (u64, [u8; 4]) = (0x081F_FFFC, [0x72, 0xB6, 0xFE, 0xE7]);
const PC: usize = 15;

impl Machine {
    /// Returns start address and length (bytes) of the RAM in which `fault` flips a bit; `None` for
    /// other faults. Fails if this is not RAM.
    pub(super) fn flipped_memory(&self, fault: &ChipFaultKind) -> Result<Option<(u32, u32)>, ChipFaultError> {
        let (start, length) = match fault {
            ChipFaultKind::FlipRam { start, length, .. } => (*start, *length),
            ChipFaultKind::FlipVariable { name, .. } => {
                Symbols::variable(&self.image.elf, name).ok_or_else(|| ChipFaultError::NoVariable(name.clone()))?
            }
            _ => return Ok(None),
        };
        let at = u64::from(start);
        let is_ram =
            self.bus.memory.is_writable(at) == Some(true) && self.bus.memory.slice(at, length as usize).is_some();
        if is_ram { Ok(Some((start, length))) } else { Err(ChipFaultError::NoRam { start, length }) }
    }

    pub(super) fn apply_fault(&mut self, fault: &ChipFaultKind) -> Result<(), TargetError> {
        self.is_faulted = true;
        let now = VirtualNanos(self.now_ns());
        match *fault {
            ChipFaultKind::FlipRam { draw, .. } | ChipFaultKind::FlipVariable { draw, .. } => {
                let memory = self.flipped_memory(fault).map_err(|error| emulator_error(&error))?;
                if let Some((start, length)) = memory {
                    let bit = draw % (u64::from(length) * 8);
                    let address = u64::from(start) + bit / 8;
                    let byte = self.bus.memory.slice(address, 1).and_then(<[u8]>::first).copied().unwrap_or_default();
                    self.bus.memory.store(address, &[byte ^ 1 << (bit % 8)]);
                }
            }
            ChipFaultKind::FlipRegister { number, draw } => {
                let mut bytes = self.core.gdb_register(number).unwrap_or_default();
                let bit = draw as usize % (8 * bytes.len().max(1));
                if let Some(byte) = bytes.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
                self.core.set_gdb_register(number, &bytes);
            }
            ChipFaultKind::Reset | ChipFaultKind::PowerCut => {
                if *fault == ChipFaultKind::PowerCut {
                    self.bus.memory.power_off();
                }
                let instructions = self.core.retired();
                self.session.reset_by_pin(now, instructions, &mut self.bus);
            }
            ChipFaultKind::Hang => {
                self.bus.memory.store(HANG.0, &HANG.1);
                self.core.set_gdb_register(PC, &(HANG.0 as u32).to_le_bytes());
            }
            ChipFaultKind::Stuck { address, value } => self.bus.stuck.push((address, value)),
            ChipFaultKind::ClockDrift { .. } => {}
        }
        self.bus.notify_core(&mut *self.core);
        Ok(())
    }
}
