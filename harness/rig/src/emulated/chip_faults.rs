//! Applies planned faults to the emulated chip at their instants: flipped bits, resets, a hang, stuck
//! registers.

use super::machine::{Machine, emulator_error};
use crate::link::{ChipFaultError, ChipFaultPlan, DatedChipFault, TargetError};
use crate::symbols::Symbols;
use platebench_model::scenario::{BitFlipTarget, ChipFaultKind};
use rigless::time::VirtualNanos;
use std::collections::VecDeque;
use std::time::Duration;

const PPM: f64 = 1e-6;

#[derive(Debug, Default)]
pub(super) struct ChipFaults {
    pub(super) plan: ChipFaultPlan,
    pending: VecDeque<DatedChipFault>,
    /// Trial time at which a clock drift starts, and the drift in ppm. A positive drift means that
    /// the chip's clocks are faster.
    drift: Option<(Duration, f64)>,
    /// True if the firmware has enabled the amplifier in this trial.
    pub(super) uses_amplifier: bool,
}

impl ChipFaults {
    pub(super) fn is_active(&self) -> bool {
        !self.plan.faults.is_empty()
    }

    pub(super) fn start_trial(&mut self) {
        self.pending = self.plan.faults.iter().cloned().collect();
        self.drift = None;
        self.uses_amplifier = false;
    }

    /// Converts trial time to time on the chip's clock.
    pub(super) fn chip_time(&self, now: Duration) -> Duration {
        match self.drift {
            Some((from, ppm)) if now > from => {
                let shift_ns = now.saturating_sub(from).as_nanos() as f64 * ppm * PPM;
                let shift = Duration::from_nanos(shift_ns.abs() as u64);
                if shift_ns < 0.0 { now.saturating_sub(shift) } else { now + shift }
            }
            _ => now,
        }
    }

    /// The inverse of [`Self::chip_time`].
    pub(super) fn trial_time(&self, chip_time: Duration) -> Duration {
        match self.drift {
            Some((from, ppm)) if chip_time > from => {
                let since_ns = chip_time.saturating_sub(from).as_nanos() as f64 / (1.0 + ppm * PPM);
                from + Duration::from_nanos(since_ns.round() as u64)
            }
            _ => chip_time,
        }
    }

    pub(super) fn next(&self) -> Option<Duration> {
        self.pending.front().map(|fault| fault.at)
    }

    pub(super) fn apply_next(&mut self, machine: &mut Machine) -> Result<(), TargetError> {
        let Some(fault) = self.pending.pop_front() else { return Ok(()) };
        if let ChipFaultKind::ClockDrift(ppm) = fault.kind {
            self.drift = Some((fault.at, ppm));
            return Ok(());
        }
        machine.apply_fault(&fault)
    }
}

/// Address and code of an endless loop (`cpsid i; b .`) in the last bytes of flash, which are
/// rarely used.
const HANG: (u64, [u8; 4]) = (0x081F_FFFC, [0x72, 0xB6, 0xFE, 0xE7]);
const PC: usize = 15;

impl Machine {
    /// Returns start address and length (bytes) of the RAM in which `fault` flips a bit; `None` for
    /// other faults. Fails if this is not RAM.
    pub(super) fn flipped_memory(&self, fault: &ChipFaultKind) -> Result<Option<(u32, u32)>, ChipFaultError> {
        let ChipFaultKind::BitFlip { target, .. } = fault else { return Ok(None) };
        let (start, length) = match target {
            BitFlipTarget::Ram { start, length } => (*start, *length),
            BitFlipTarget::Variable(name) => {
                Symbols::variable(&self.image.elf, name).ok_or_else(|| ChipFaultError::NoVariable(name.clone()))?
            }
            BitFlipTarget::Register(_) => return Ok(None),
        };
        let at = u64::from(start);
        let is_ram =
            self.bus.memory.is_writable(at) == Some(true) && self.bus.memory.slice(at, length as usize).is_some();
        if is_ram { Ok(Some((start, length))) } else { Err(ChipFaultError::NoRam { start, length }) }
    }

    pub(super) fn apply_fault(&mut self, fault: &DatedChipFault) -> Result<(), TargetError> {
        self.is_faulted = true;
        let now = VirtualNanos(self.now_ns());
        let DatedChipFault { kind, draw, .. } = fault;
        match *kind {
            ChipFaultKind::BitFlip { target: BitFlipTarget::Register(number), .. } => {
                let mut bytes = self.core.gdb_register(number).unwrap_or_default();
                let bit = *draw as usize % (8 * bytes.len().max(1));
                if let Some(byte) = bytes.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
                self.core.set_gdb_register(number, &bytes);
            }
            ChipFaultKind::BitFlip { .. } => {
                let memory = self.flipped_memory(kind).map_err(|error| emulator_error(&error))?;
                if let Some((start, length)) = memory {
                    let bit = draw % (u64::from(length) * 8);
                    let address = u64::from(start) + bit / 8;
                    let byte = self.bus.memory.slice(address, 1).and_then(<[u8]>::first).copied().unwrap_or_default();
                    self.bus.memory.store(address, &[byte ^ 1 << (bit % 8)]);
                }
            }
            ChipFaultKind::Reset | ChipFaultKind::PowerCut => {
                if *kind == ChipFaultKind::PowerCut {
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
            ChipFaultKind::ClockDrift(_) => {}
        }
        self.bus.notify_core(&mut *self.core);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trial_time_is_the_inverse_of_chip_time() {
        let at = Duration::from_millis(40);
        for (from_ms, ppm) in [(20, 20_000.0), (20, -20_000.0), (40, 20_000.0), (0, -1.0)] {
            let drift = Some((Duration::from_millis(from_ms), ppm));
            let faults = ChipFaults { drift, ..ChipFaults::default() };
            let back = faults.trial_time(faults.chip_time(at));
            assert!(back.abs_diff(at) <= Duration::from_nanos(1), "{from_ms} ms, {ppm} ppm: {back:?}");
        }
        let faults = ChipFaults { drift: Some((Duration::from_millis(20), 20_000.0)), ..ChipFaults::default() };
        assert_eq!(faults.trial_time(Duration::from_micros(40_400)), at);
    }
}
