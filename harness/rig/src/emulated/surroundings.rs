//! What the emulated processor reaches while it runs: memory, the part's models, and virtual time.

use super::board::Bench;
use super::memory::Memory;
use rigless::device::Level;
use rigless::emulator::{
    Access, AccessKind, CoreBus, Error, Host, InterruptLine, Memory as GuestMemory, Processor, Queued,
};
use rigless::session::Session;
use rigless::soc::Width;
use rigless::time::{NO_DEADLINE, VirtualNanos};
use std::num::NonZeroU64;

/// The processor comes back at least this often, whatever the models say.
const LONGEST_RUN: u64 = 1 << 20;

/// Everything around the processor that is not a model.
#[derive(Debug)]
pub(super) struct Surroundings {
    pub(super) memory: Memory,
    queued: Vec<Queued>,
    pace: Pace,
    /// Time that passed while the processor slept.
    pub(super) slept_ns: u64,
    /// The next instant at which a model wants a look.
    pub(super) deadline: VirtualNanos,
    pub(super) restart: bool,
}

/// How long instructions take, as a fraction in its lowest terms: with that, years fit 64 bits, and converting is cheap enough to do at every event.
#[derive(Debug, Clone, Copy)]
struct Pace {
    nanoseconds: u64,
    instructions: NonZeroU64,
}

impl Pace {
    fn new(instructions_per_second: NonZeroU64) -> Self {
        const NS_PER_S: u64 = 1_000_000_000;
        let (mut divisor, mut rest) = (NS_PER_S, instructions_per_second.get());
        while rest > 0 {
            (divisor, rest) = (rest, divisor % rest);
        }
        let instructions = NonZeroU64::new(instructions_per_second.get() / divisor).unwrap_or(instructions_per_second);
        Self { nanoseconds: NS_PER_S / divisor, instructions }
    }

    /// The time that so many instructions take, rounded down.
    fn nanoseconds(self, instructions: u64) -> u64 {
        instructions.saturating_mul(self.nanoseconds) / self.instructions
    }

    /// The first instruction count that takes so long.
    fn instructions(self, nanoseconds: u64) -> u64 {
        nanoseconds.saturating_mul(self.instructions.get()).div_ceil(self.nanoseconds)
    }
}

impl Surroundings {
    pub(super) fn new(memory: Memory, instructions_per_second: NonZeroU64) -> Self {
        let (pace, deadline) = (Pace::new(instructions_per_second), NO_DEADLINE);
        Self { memory, queued: Vec::new(), pace, slept_ns: 0, deadline, restart: false }
    }

    /// As at power-on.
    pub(super) fn forget(&mut self) {
        self.memory.forget();
        self.queued.clear();
        self.slept_ns = 0;
        self.deadline = NO_DEADLINE;
        self.restart = false;
    }

    /// The instant at which that many instructions are executed.
    pub(super) fn time(&self, instructions: u64) -> VirtualNanos {
        VirtualNanos(self.slept_ns + self.pace.nanoseconds(instructions))
    }

    /// How many more instructions lead to `target`; at least one.
    pub(super) fn instructions_until(&self, instructions: u64, target: VirtualNanos) -> u32 {
        let needed = self.pace.instructions(target.0.saturating_sub(self.slept_ns));
        needed.saturating_sub(instructions).clamp(1, LONGEST_RUN) as u32
    }

    /// The processor's own next event or that of a model.
    pub(super) fn next(&self, event: Option<VirtualNanos>) -> VirtualNanos {
        event.map_or(self.deadline, |event| event.min(self.deadline))
    }

    /// Tells the processor what happened around it.
    pub(super) fn tell(&mut self, core: &mut dyn Processor) {
        for queued in self.queued.drain(..) {
            core.ask(queued);
        }
        for range in self.memory.take_written() {
            core.ask(Queued::Invalidate(range.start, range.end));
        }
    }
}

impl GuestMemory for Surroundings {
    fn read(&mut self, address: u64, width: Width) -> Result<u64, Error> {
        GuestMemory::read(&mut self.memory, address, width)
    }

    fn write(&mut self, address: u64, width: Width, value: u64) -> Result<(), Error> {
        GuestMemory::write(&mut self.memory, address, width, value)
    }
}

impl Host for Surroundings {
    fn set_interrupt(&mut self, line: InterruptLine, level: Level) {
        self.queued.push(Queued::Line(line, level));
    }

    fn request_reset(&mut self) {
        self.restart = true;
        self.queued.push(Queued::Return);
    }
}

/// The surroundings together with the models, for one run of the processor.
pub(super) struct Lent<'a> {
    pub(super) surroundings: &'a mut Surroundings,
    pub(super) session: &'a mut Session<Bench>,
}

impl CoreBus for Lent<'_> {
    fn access(&mut self, access: Access, _from_code: bool) -> Option<u64> {
        let memory = &mut self.surroundings.memory;
        let writable = memory.writable(access.address);
        match (writable, access.kind) {
            (Some(_), AccessKind::Read) => {
                if let Some(value) = memory.value(access.address, access.width) {
                    return Some(value);
                }
            }
            (Some(true), AccessKind::Write) => {
                let bytes = access.value.to_le_bytes();
                memory.place(access.address, bytes.get(..access.width.bytes() as usize)?);
                return Some(access.value);
            }
            (Some(false), AccessKind::Write) | (None, _) => {}
        }
        // Where nothing answers, the part has a bus error; the emulator by itself would let that pass.
        let answers = self.session.board_mut().part.touch(access.address);
        if !answers && writable.is_none() {
            return None;
        }
        let (value, next) = self.session.access(access, self.surroundings);
        self.surroundings.deadline = next;
        (!self.session.take_failure()).then_some(value)
    }

    fn time(&self, instructions: u64) -> VirtualNanos {
        self.surroundings.time(instructions)
    }

    fn queued(&mut self) -> Vec<Queued> {
        let Surroundings { memory, queued, .. } = &mut *self.surroundings;
        queued.extend(memory.take_written().map(|range| Queued::Invalidate(range.start, range.end)));
        std::mem::take(queued)
    }

    fn carry_on(&mut self, instructions: u64, event: Option<VirtualNanos>) -> Option<u32> {
        if self.surroundings.restart {
            return None;
        }
        let target = self.surroundings.next(event);
        let time_left = target > self.surroundings.time(instructions);
        time_left.then(|| self.surroundings.instructions_until(instructions, target))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_and_instructions_agree_with_arithmetic_in_128_bits() {
        const NS_PER_S: u128 = 1_000_000_000;
        for rate in [168_000_000, 1, 7, 999_999_937, 1_000_000_000, 3_000_000_000] {
            let pace = Pace::new(NonZeroU64::new(rate).unwrap());
            for count in [0, 1, 20, 21, 22, 167_999_999, 168_000_000, 168_000_001, 9_000_000_000] {
                let exact = u128::from(count) * NS_PER_S / u128::from(rate);
                assert_eq!(u128::from(pace.nanoseconds(count)), exact, "{count} instructions at {rate}/s");
                let exact = (u128::from(count) * u128::from(rate)).div_ceil(NS_PER_S);
                assert_eq!(u128::from(pace.instructions(count)), exact, "{count} ns at {rate}/s");
            }
        }
    }

    #[test]
    fn a_deadline_that_never_comes_is_far_away_and_no_overflow() {
        let pace = Pace::new(NonZeroU64::new(168_000_000).unwrap());
        assert!(pace.instructions(u64::MAX) > u64::from(u32::MAX));
        assert!(pace.nanoseconds(u64::MAX) > 1 << 57);
    }
}
