//! The target's own timer as the pace of the control.

use platebench_wire::{Configure, Message, Packet, State, Tick};

/// A bench that does not answer the first ticks for this long is not coming, µs.
const FIRST_SAMPLE_WITHIN_US: u32 = 1_000_000;

/// Says when a period begins. Periods are counted from the configuration, so that late calls do not add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pacer {
    period_us: u32,
    configured_us: u32,
    /// When the present period began.
    since_us: u32,
    /// Ticks count by themselves.
    sequence: u8,
}

impl Pacer {
    /// Begins one period after a configuration that was accepted at `now_us`.
    pub(crate) fn new(configure: &Configure, now_us: u32) -> Self {
        Self { period_us: configure.period_us, configured_us: now_us, since_us: now_us, sequence: 0 }
    }

    /// When [`Pacer::tick`] has something to say next, on the target's clock.
    pub(crate) fn next_us(&self) -> u32 {
        self.since_us.wrapping_add(self.period_us)
    }

    /// False where no period of a controller in `state` is to be told any more.
    pub(crate) fn goes_on(&self, state: State, now_us: u32) -> bool {
        match state {
            State::Idle => now_us.wrapping_sub(self.configured_us) < FIRST_SAMPLE_WITHIN_US,
            State::Running => true,
            State::Fault | State::Safe => false,
        }
    }

    /// The tick of a period that has begun since the last call. Periods that went by unseen are skipped: their samples would come too late.
    pub(crate) fn tick(&mut self, now_us: u32) -> Option<Packet> {
        let elapsed_us = now_us.wrapping_sub(self.since_us);
        let periods = elapsed_us.checked_div(self.period_us)?;
        if periods == 0 {
            return None;
        }
        self.since_us = self.since_us.wrapping_add(periods * self.period_us);
        self.sequence = self.sequence.wrapping_add(1);
        let message = Message::Tick(Tick { target_time_us: now_us });
        Some(Packet { sequence: self.sequence, message })
    }
}
