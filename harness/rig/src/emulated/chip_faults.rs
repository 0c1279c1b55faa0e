//! Applies planned faults of the chip at their instants.

use super::machine::Machine;
use crate::chip_fault::{ChipFault, ChipFaultKind, ChipFaultPlan};
use crate::target_error::TargetError;
use std::collections::VecDeque;
use std::time::Duration;

const PPM: f64 = 1e-6;

#[derive(Debug, Default)]
pub(super) struct ChipFaults {
    pub(super) plan: ChipFaultPlan,
    pending: VecDeque<ChipFault>,
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

    pub(super) fn next(&self) -> Option<Duration> {
        self.pending.front().map(|fault| fault.at)
    }

    pub(super) fn apply_next(&mut self, machine: &mut Machine) -> Result<(), TargetError> {
        let Some(fault) = self.pending.pop_front() else { return Ok(()) };
        match fault.kind {
            ChipFaultKind::ClockDrift { ppm } => {
                self.drift = Some((fault.at, ppm));
                Ok(())
            }
            kind => machine.apply_fault(&kind),
        }
    }
}
