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

const NS_PER_S: u128 = 1_000_000_000;
/// The processor comes back at least this often, whatever the models say.
const LONGEST_RUN: u128 = 1 << 20;

/// Everything around the processor that is not a model.
#[derive(Debug)]
pub(super) struct Surroundings {
    pub(super) memory: Memory,
    queued: Vec<Queued>,
    instructions_per_second: NonZeroU64,
    /// Time that passed while the processor slept.
    pub(super) slept_ns: u64,
    /// The next instant at which a model wants a look.
    pub(super) deadline: VirtualNanos,
    pub(super) restart: bool,
}

impl Surroundings {
    pub(super) fn new(memory: Memory, instructions_per_second: NonZeroU64) -> Self {
        let deadline = NO_DEADLINE;
        Self { memory, queued: Vec::new(), instructions_per_second, slept_ns: 0, deadline, restart: false }
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
        let rate = u128::from(self.instructions_per_second.get());
        VirtualNanos(self.slept_ns + (u128::from(instructions) * NS_PER_S / rate) as u64)
    }

    /// How many more instructions lead to `target`; at least one.
    pub(super) fn instructions_until(&self, instructions: u64, target: VirtualNanos) -> u32 {
        let awake_ns = u128::from(target.0.saturating_sub(self.slept_ns));
        let needed = (awake_ns * u128::from(self.instructions_per_second.get())).div_ceil(NS_PER_S);
        needed.saturating_sub(u128::from(instructions)).clamp(1, LONGEST_RUN) as u32
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
