//! Sends a tick per control period if the target's own timer paces the control.

use platebench_wire::{Configure, ControllerState, Message, Packet, Tick};

/// If no sample arrives within this time after the configuration, the target stops sending ticks.
const FIRST_SAMPLE_TIMEOUT_US: u32 = 1_000_000;

/// Counts periods from the configuration, so that a late call does not shift later periods.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pacer {
    period_us: u32,
    configured_us: u32,
    period_start_us: u32,
    sequence: u8,
}

impl Pacer {
    /// The first period begins one period after the configuration at `now_us`.
    pub(crate) fn new(configure: &Configure, now_us: u32) -> Self {
        Self { period_us: configure.period_us, configured_us: now_us, period_start_us: now_us, sequence: 0 }
    }

    pub(crate) fn next_us(&self) -> u32 {
        self.period_start_us.wrapping_add(self.period_us)
    }

    pub(crate) fn is_active(&self, state: ControllerState, now_us: u32) -> bool {
        match state {
            ControllerState::Idle => now_us.wrapping_sub(self.configured_us) < FIRST_SAMPLE_TIMEOUT_US,
            ControllerState::Running => true,
            ControllerState::Fault | ControllerState::Safe => false,
        }
    }

    /// Returns one tick for all elapsed periods; samples of missed periods would be too late.
    pub(crate) fn tick(&mut self, now_us: u32) -> Option<Packet> {
        let elapsed_us = now_us.wrapping_sub(self.period_start_us);
        let periods = elapsed_us.checked_div(self.period_us)?;
        if periods == 0 {
            return None;
        }
        self.period_start_us = self.period_start_us.wrapping_add(periods * self.period_us);
        self.sequence = self.sequence.wrapping_add(1);
        let message = Message::Tick(Tick { target_time_us: now_us });
        Some(Packet { sequence: self.sequence, message })
    }
}
