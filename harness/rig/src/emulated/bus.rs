//! Connects the emulated processor to memory, peripherals and virtual time.

use super::board::EmulatedBoard;
use super::memory::Memory;
use gdbstub::target::ext::breakpoints::WatchKind;
use rigless::device::Level;
use rigless::emulator::{
    Access, AccessKind, CoreBus, Error, Host, InterruptLine, Memory as GuestMemory, Processor, Queued,
};
use rigless::session::Session;
use rigless::soc::Width;
use rigless::time::{NO_DEADLINE, VirtualNanos};
use std::num::NonZeroU64;

const MAX_RUN_INSTRUCTIONS: u64 = 1 << 20;
/// Control register of stream 6 of DMA1, which sends through USART2 (RM0090, table 42).
const TRANSMIT_STREAM: u64 = 0x4002_60A0;

#[derive(Debug)]
pub(super) struct SystemBus {
    pub(super) memory: Memory,
    queued: Vec<Queued>,
    rate: InstructionRate,
    pub(super) slept_ns: u64,
    pub(super) deadline: VirtualNanos,
    pub(super) reset_requested: bool,
    /// Addresses of registers whose reads always return the same value, and this value.
    pub(super) stuck: Vec<(u32, u32)>,
    pub(super) enable_pin: PinLog,
    /// Watchpoints of a debugger, and the address of the first access that one of them stops.
    pub(super) watchpoints: Vec<Watchpoint>,
    pub(super) watch_hit: Option<(u32, WatchKind)>,
    /// First use of a part of the flash interface without a model.
    pub(super) unmodelled: Option<UnmodelledAccess>,
    /// Address and instruction of each access that the chip refused, in order of time.
    pub(super) refused: Vec<(u64, u64)>,
    /// Instruction of the access after which a model first reported a violated rule.
    pub(super) told_at: Option<u64>,
}

/// Registers of the port with the pin that enables the amplifier.
const GPIOB: std::ops::Range<u64> = 0x4002_0400..0x4002_0800;

/// The pin that enables the amplifier since the start of the trial.
#[derive(Debug, Clone, Copy)]
pub(super) struct PinLog {
    pub(super) was_high: bool,
    /// `None` if the pin is high.
    pub(super) low_since_ns: Option<u64>,
}

impl Default for PinLog {
    fn default() -> Self {
        Self { was_high: false, low_since_ns: Some(0) }
    }
}

impl PinLog {
    /// Begins a trial with the present level.
    pub(super) fn start(&mut self, now_ns: u64) {
        let is_high = self.low_since_ns.is_none();
        *self = Self { was_high: is_high, low_since_ns: (!is_high).then_some(now_ns) };
    }

    pub(super) fn shift(&mut self, by_ns: u64) {
        self.low_since_ns = self.low_since_ns.map(|since| since + by_ns);
    }

    pub(super) fn record(&mut self, is_high: bool, now_ns: u64) {
        self.was_high |= is_high;
        self.low_since_ns = if is_high { None } else { self.low_since_ns.or(Some(now_ns)) };
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Watchpoint {
    pub(super) start: u64,
    pub(super) length: u64,
    pub(super) kind: WatchKind,
}

impl Watchpoint {
    fn is_hit_by(&self, access: &Access) -> bool {
        let is_of_kind = match self.kind {
            WatchKind::Write => access.kind == AccessKind::Write,
            WatchKind::Read => access.kind == AccessKind::Read,
            WatchKind::ReadWrite => true,
        };
        let end = access.address + u64::from(access.width.bytes());
        is_of_kind && access.address < self.start + self.length && self.start < end
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct UnmodelledAccess {
    pub(super) what: &'static str,
    pub(super) address: u64,
    pub(super) instruction: Option<u64>,
}

/// Control register of flash and the bit that starts an erase (RM0090, 3.9.8).
const FLASH_CR: u64 = 0x4002_3C10;
const FLASH_CR_START: u64 = 1 << 16;
/// Option control register and the bit that starts their programming (RM0090, 3.9.10).
const FLASH_OPTCR: u64 = 0x4002_3C14;
const FLASH_OPTCR_START: u64 = 1 << 1;
/// Option bytes of both banks (RM0090, table 15).
const OPTION_BYTES: [std::ops::Range<u64>; 2] = [0x1FFE_C000..0x1FFE_C010, 0x1FFF_C000..0x1FFF_C010];

/// What the access needs if the emulator does not model it. The chip itself would do it.
fn unmodelled(access: &Access) -> Option<&'static str> {
    let starts = |bits: u64| access.kind == AccessKind::Write && access.value & bits != 0;
    match access.address {
        FLASH_CR if starts(FLASH_CR_START) => Some("the erase of flash is not modelled, FLASH.CR written with STRT"),
        FLASH_OPTCR if starts(FLASH_OPTCR_START) => {
            Some("the programming of option bytes is not modelled, FLASH.OPTCR written with OPTSTRT")
        }
        address if OPTION_BYTES.iter().any(|bytes| bytes.contains(&address)) => {
            Some("the option bytes are not modelled as memory; FLASH.OPTCR contains them")
        }
        _ => None,
    }
}

/// Nanoseconds per instruction in lowest terms, so that years of time fit into 64 bits.
#[derive(Debug, Clone, Copy)]
struct InstructionRate {
    nanoseconds: u64,
    instructions: NonZeroU64,
}

impl InstructionRate {
    fn new(instructions_per_second: NonZeroU64) -> Self {
        const NS_PER_S: u64 = 1_000_000_000;
        let (mut divisor, mut rest) = (NS_PER_S, instructions_per_second.get());
        while rest > 0 {
            (divisor, rest) = (rest, divisor % rest);
        }
        let instructions = NonZeroU64::new(instructions_per_second.get() / divisor).unwrap_or(instructions_per_second);
        Self { nanoseconds: NS_PER_S / divisor, instructions }
    }

    fn nanoseconds(self, instructions: u64) -> u64 {
        instructions.saturating_mul(self.nanoseconds) / self.instructions
    }

    fn instructions(self, nanoseconds: u64) -> u64 {
        nanoseconds.saturating_mul(self.instructions.get()).div_ceil(self.nanoseconds)
    }
}

impl SystemBus {
    pub(super) fn new(memory: Memory, instructions_per_second: NonZeroU64) -> Self {
        let (rate, deadline) = (InstructionRate::new(instructions_per_second), NO_DEADLINE);
        Self {
            memory,
            queued: Vec::new(),
            rate,
            slept_ns: 0,
            deadline,
            reset_requested: false,
            stuck: Vec::new(),
            enable_pin: PinLog::default(),
            watchpoints: Vec::new(),
            watch_hit: None,
            unmodelled: None,
            refused: Vec::new(),
            told_at: None,
        }
    }

    pub(super) fn reset(&mut self) {
        self.memory.power_off();
        self.queued.clear();
        self.slept_ns = 0;
        self.deadline = NO_DEADLINE;
        self.reset_requested = false;
        self.stuck.clear();
        self.enable_pin = PinLog::default();
        self.watch_hit = None;
        self.unmodelled = None;
        self.refused.clear();
        self.told_at = None;
    }

    pub(super) fn time_at(&self, instructions: u64) -> VirtualNanos {
        VirtualNanos(self.slept_ns + self.rate.nanoseconds(instructions))
    }

    pub(super) fn nanoseconds_of(&self, instructions: u64) -> u64 {
        self.rate.nanoseconds(instructions)
    }

    pub(super) fn instructions_in(&self, nanoseconds: u64) -> u64 {
        self.rate.instructions(nanoseconds)
    }

    pub(super) fn instructions_until(&self, instructions: u64, target: VirtualNanos) -> u32 {
        let needed = self.rate.instructions(target.0.saturating_sub(self.slept_ns));
        needed.saturating_sub(instructions).clamp(1, MAX_RUN_INSTRUCTIONS) as u32
    }

    pub(super) fn next_event(&self, event: Option<VirtualNanos>) -> VirtualNanos {
        event.map_or(self.deadline, |event| event.min(self.deadline))
    }

    pub(super) fn notify_core(&mut self, core: &mut dyn Processor) {
        for queued in self.queued.drain(..) {
            core.ask(queued);
        }
        for range in self.memory.take_dirty_ranges() {
            core.ask(Queued::Invalidate(range.start, range.end));
        }
    }
}

impl GuestMemory for SystemBus {
    fn read(&mut self, address: u64, width: Width) -> Result<u64, Error> {
        GuestMemory::read(&mut self.memory, address, width)
    }

    fn write(&mut self, address: u64, width: Width, value: u64) -> Result<(), Error> {
        GuestMemory::write(&mut self.memory, address, width, value)
    }
}

impl Host for SystemBus {
    fn set_interrupt(&mut self, line: InterruptLine, level: Level) {
        self.queued.push(Queued::Line(line, level));
    }

    fn request_reset(&mut self) {
        self.reset_requested = true;
        self.queued.push(Queued::Return);
    }
}

pub(super) struct BusGuard<'a> {
    pub(super) bus: &'a mut SystemBus,
    pub(super) session: &'a mut Session<EmulatedBoard>,
}

impl BusGuard<'_> {
    /// Stops the processor after an instruction whose access a debugger watches.
    fn stop_at_watchpoint(&mut self, access: &Access) {
        let hit = self.bus.watchpoints.iter().find(|watchpoint| watchpoint.is_hit_by(access));
        if let Some(hit) = hit.filter(|_| access.program_counter.is_some()) {
            self.bus.watch_hit.get_or_insert((access.address as u32, hit.kind));
            self.bus.queued.push(Queued::Return);
        }
    }

    /// Transports the words that are due before an access that shows them. After a write, words may
    /// no longer pass as a block.
    fn transport_due_words(&mut self, access: &Access) {
        let now = access.virtual_time;
        let part = &mut self.session.board_mut().part;
        if !part.shows_words(access.address) {
            return;
        }
        if part.catch_up(now.0) {
            let until = self.session.until();
            self.bus.deadline = self.session.resume(until, now, access.instruction_count, self.bus);
        }
        let part = &mut self.session.board_mut().part;
        part.port.report_sent(now.0);
        if access.kind == AccessKind::Write {
            part.continue_word_by_word(now.0);
        }
    }
}

impl CoreBus for BusGuard<'_> {
    fn access(&mut self, access: Access, _from_code: bool) -> Option<u64> {
        if !self.bus.watchpoints.is_empty() {
            self.stop_at_watchpoint(&access);
        }
        let memory = &mut self.bus.memory;
        let writable = memory.is_writable(access.address);
        match (writable, access.kind) {
            (Some(_), AccessKind::Read) => {
                if let Some(value) = memory.value(access.address, access.width) {
                    return Some(value);
                }
            }
            (Some(true), AccessKind::Write) => {
                let bytes = access.value.to_le_bytes();
                memory.store(access.address, bytes.get(..access.width.bytes() as usize)?);
                return Some(access.value);
            }
            (Some(false), AccessKind::Write) | (None, _) => {}
        }
        if self.bus.unmodelled.is_none()
            && let Some(what) = unmodelled(&access)
        {
            let (address, instruction) = (access.address, access.program_counter);
            self.bus.unmodelled = Some(UnmodelledAccess { what, address, instruction });
            if !self.session.board().part.has_register(address) {
                return Some(0);
            }
        }
        // If nothing is at the address, the chip raises a bus error. The emulator alone would
        // ignore the access.
        let answers = self.session.board_mut().part.mark_used(&access);
        if !answers && writable.is_none() {
            return None;
        }
        let stuck = self.bus.stuck.iter().find(|(address, _)| u64::from(*address) == access.address & !3);
        if let Some(&(_, value)) = stuck {
            let byte = access.address & 3;
            return Some(if access.kind == AccessKind::Read { u64::from(value) >> (8 * byte) } else { access.value });
        }
        if self.session.board().part.port.has_deferred_words() {
            self.transport_due_words(&access);
        }
        let refused = self.session.refused().len();
        let has_told = self.session.told().next().is_some();
        let (value, next) = self.session.access(access, self.bus);
        self.bus.deadline = next;
        if self.session.refused().len() > refused
            && let Some(instruction) = access.program_counter
        {
            self.bus.refused.push((access.address, instruction));
        }
        if !has_told && self.session.told().next().is_some() {
            self.bus.told_at = access.program_counter;
        }
        if access.kind == AccessKind::Write && GPIOB.contains(&access.address) {
            let is_high = self.session.board().amplifier_enabled();
            self.bus.enable_pin.record(is_high, access.virtual_time.0);
        }
        // An access to the clock controller ends the time in which unused peripherals are not polled.
        if access.kind == AccessKind::Write && !self.session.board().part.booted {
            self.session.board_mut().part.follow_clocks(access.address, access.virtual_time.0);
            self.bus.deadline = self.session.next_deadline();
        }
        if access.address == TRANSMIT_STREAM && access.kind == AccessKind::Write {
            let memory = &self.bus.memory;
            let read = |address, length| memory.slice(address, length);
            self.session.board_mut().part.start_sending(access.virtual_time.0, read);
        }
        (!self.session.take_failure()).then_some(value)
    }

    fn time(&self, instructions: u64) -> VirtualNanos {
        self.bus.time_at(instructions)
    }

    fn queued(&mut self) -> Vec<Queued> {
        let SystemBus { memory, queued, .. } = &mut *self.bus;
        queued.extend(memory.take_dirty_ranges().map(|range| Queued::Invalidate(range.start, range.end)));
        std::mem::take(queued)
    }

    fn carry_on(&mut self, instructions: u64, event: Option<VirtualNanos>) -> Option<u32> {
        if self.bus.reset_requested {
            return None;
        }
        let target = self.bus.next_event(event);
        let time_left = target > self.bus.time_at(instructions);
        time_left.then(|| self.bus.instructions_until(instructions, target))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn converts_time_and_instructions_exactly() {
        const NS_PER_S: u128 = 1_000_000_000;
        for per_second in [168_000_000, 1, 7, 999_999_937, 1_000_000_000, 3_000_000_000] {
            let rate = InstructionRate::new(NonZeroU64::new(per_second).unwrap());
            for count in [0, 1, 20, 21, 22, 167_999_999, 168_000_000, 168_000_001, 9_000_000_000] {
                let exact = u128::from(count) * NS_PER_S / u128::from(per_second);
                assert_eq!(u128::from(rate.nanoseconds(count)), exact, "{count} instructions at {per_second}/s");
                let exact = (u128::from(count) * u128::from(per_second)).div_ceil(NS_PER_S);
                assert_eq!(u128::from(rate.instructions(count)), exact, "{count} ns at {per_second}/s");
            }
        }
    }

    #[test]
    fn saturates_for_a_deadline_that_never_comes() {
        let rate = InstructionRate::new(NonZeroU64::new(168_000_000).unwrap());
        assert!(rate.instructions(u64::MAX) > u64::from(u32::MAX));
        assert!(rate.nanoseconds(u64::MAX) > 1 << 57);
    }
}
