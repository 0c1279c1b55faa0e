//! What is read out of an emulated board when its firmware trapped, reset itself or reached for something that is not there.

use super::board::Bench;
use super::fault::{Gap, Trap};
use super::image::{FLASH_START, Image};
use super::memory::Memory;
use super::surroundings::Surroundings;
use crate::symbols::{Place, Symbols};
use rigless::device::ResetCause;
use rigless::emulator::Processor;
use rigless::session::Session;
use rigless::soc::Width;
use rigless::time::VirtualNanos;

const EXCEPTIONS: [(u32, &str); 5] =
    [(2, "NMI"), (3, "HardFault"), (4, "MemManage"), (5, "BusFault"), (6, "UsageFault")];
const PANIC: &str = "panic";

/// The debugger's numbers of the registers.
const SP: usize = 13;
const LR: usize = 14;
const XPSR: usize = 16;

const CFSR: u64 = 0xE000_ED28;
const HFSR: u64 = 0xE000_ED2C;
const MMFAR: u64 = 0xE000_ED34;
const BFAR: u64 = 0xE000_ED38;
const MEMORY_ADDRESS_VALID: u32 = 1 << 7;
const BUS_ADDRESS_VALID: u32 = 1 << 15;

/// Offsets of lr and pc in what the processor stacks.
const STACKED_LR: u64 = 20;
const STACKED_PC: u64 = 24;

const LONGEST_BACKTRACE: usize = 6;
const STACK_SEARCHED: usize = 4_096;

/// The addresses at which an exception or a panic arrives.
#[derive(Debug)]
pub(super) struct Handlers {
    exceptions: Vec<u64>,
    panic: Option<u64>,
}

impl Handlers {
    pub(super) fn none() -> Self {
        Self { exceptions: Vec::new(), panic: None }
    }

    /// The handlers in the image's vector table, and its panic handler where it has one.
    pub(super) fn of(memory: &Memory, image: &Image) -> Self {
        let mut exceptions: Vec<_> = EXCEPTIONS
            .iter()
            .filter_map(|&(number, _)| memory.word(FLASH_START + 4 * u64::from(number)))
            .filter(|&vector| vector != 0 && vector != u32::MAX)
            .map(|vector| u64::from(vector & !1))
            .collect();
        exceptions.sort_unstable();
        exceptions.dedup();
        Self { exceptions, panic: Symbols::read(&image.elf).panic_handler() }
    }

    pub(super) fn watch(&self, core: &mut dyn Processor) {
        for &address in self.exceptions.iter().chain(&self.panic) {
            core.add_breakpoint(address);
        }
    }

    /// The processor stands at a handler's first instruction: what happened; `None` where it came there for another exception that shares the handler.
    pub(super) fn trap(
        &self,
        core: &mut dyn Processor,
        surroundings: &Surroundings,
        session: &mut Session<Bench>,
        image: &Image,
    ) -> Option<Trap> {
        let active = register(core, XPSR) & 0x1FF;
        let exception = if self.panic == Some(core.pc()) {
            PANIC
        } else {
            EXCEPTIONS.iter().find(|(number, _)| *number == active)?.1
        };
        let now = surroundings.time(core.retired());
        let mut system = |address| system_register(core, address, now);
        let (cfsr, hfsr, mmfar, bfar) = (system(CFSR), system(HFSR), system(MMFAR), system(BFAR));
        let address = if cfsr & BUS_ADDRESS_VALID != 0 {
            Some(bfar)
        } else {
            (cfsr & MEMORY_ADDRESS_VALID != 0).then_some(mmfar)
        };
        let (sp, symbols) = (register(core, SP), Symbols::read(&image.elf));
        let mut trap = Trap {
            exception,
            place: None,
            calls: Vec::new(),
            address,
            instance: address.and_then(|address| session.board().part.instance_at(u64::from(address))),
            cfsr,
            hfsr,
            lr: None,
            sp,
            at_us: now.0 / 1_000,
        };
        let memory = &surroundings.memory;
        let stacked = |offset| memory.word(u64::from(sp) + offset);
        let mut from = u64::from(sp);
        if exception == PANIC {
            trap.lr = Some(register(core, LR));
        } else if !trap.is_stacking_failure() {
            trap.lr = stacked(STACKED_LR);
            trap.place = stacked(STACKED_PC).map(|pc| symbols.place(pc));
            from += 32;
        }
        let mut returns: Vec<u32> = trap.lr.into_iter().filter(|&lr| is_return(memory, &symbols, lr)).collect();
        returns.extend(calls_on_stack(memory, &symbols, from, u64::from(image.initial_stack)));
        returns.dedup();
        trap.calls = returns.into_iter().map(|at| symbols.place((at & !1) - 2)).collect();
        if exception == PANIC {
            // The way through the library to the handler says nothing.
            let own = trap.calls.iter().position(is_own).unwrap_or(0);
            trap.calls.drain(..own);
        }
        trap.calls.dedup_by(|a, b| a.symbol == b.symbol);
        trap.calls.truncate(LONGEST_BACKTRACE);
        if trap.place.is_none() && !trap.calls.is_empty() {
            trap.place = Some(trap.calls.remove(0));
        }
        Some(trap)
    }
}

fn is_own(place: &Place) -> bool {
    let library = |name: &str| name.starts_with("core::") || name.contains("panic");
    place.symbol.as_deref().is_some_and(|symbol| !library(symbol))
}

fn register(core: &dyn Processor, number: usize) -> u32 {
    let bytes = core.gdb_register(number).unwrap_or_default();
    bytes.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

fn system_register(core: &mut dyn Processor, address: u64, now: VirtualNanos) -> u32 {
    core.debugger_access(None, address, Width::W32, now).unwrap_or(0) as u32
}

/// True where `word` can be the return address of a call: odd, in a function, right after a BL or BLX.
fn is_return(memory: &Memory, symbols: &Symbols, word: u32) -> bool {
    let at = u64::from(word & !1);
    let half = |at: u64| memory.value(at, Width::W16).unwrap_or(0);
    word & 1 == 1
        && symbols.is_code(at.saturating_sub(2))
        && (half(at - 4) >> 11 == 0b11110 && half(at - 2) >> 14 == 0b11 || half(at - 2) & 0xFF87 == 0x4780)
}

/// Return addresses on the stack, innermost first. A guess: what a function left behind looks like a call as well.
fn calls_on_stack(memory: &Memory, symbols: &Symbols, from: u64, top: u64) -> Vec<u32> {
    let words = (from..top).step_by(4).take(STACK_SEARCHED);
    // Below the memory there is nothing to read; an overflowed stack begins above that.
    let mut found: Vec<u32> = Vec::new();
    for word in words.filter_map(|at| memory.word(at)) {
        if found.last() != Some(&word) && is_return(memory, symbols, word) {
            found.push(word);
            if found.len() > 2 * LONGEST_BACKTRACE {
                break;
            }
        }
    }
    found
}

pub(super) fn reset_cause(cause: ResetCause) -> String {
    match cause {
        ResetCause::Model("IWDG") => "independent watchdog".to_owned(),
        ResetCause::Model(instance) => instance.to_owned(),
        ResetCause::Core => "request of the firmware".to_owned(),
        other => format!("{other:?}"),
    }
}

/// The first thing that the emulator answered without a model behind it.
pub(super) fn gap(session: &Session<Bench>, image: &Image) -> Option<Gap> {
    let place = |pc: u64| Some(Symbols::read(&image.elf).place(pc as u32));
    let part = &session.board().part;
    let gap = |what, address: u64, place| Some(Gap { what, address: Some(address as u32), place });
    if let Some((&address, access)) = session.unimplemented().first_key_value() {
        let did = match (access.reads, access.writes) {
            (_, 0) => "read",
            (0, _) => "written",
            _ => "read and written",
        };
        return gap(format!("{}.{} {did}", access.instance, access.register), address, place(access.program_counter));
    }
    if let Some(access) = session.unmapped().first() {
        let what = match part.instance_at(access.address) {
            Some(instance) => format!("this access to {instance}"),
            None => "anything at this address".to_owned(),
        };
        return gap(what, access.address, place(access.program_counter));
    }
    if let Some((&address, fault)) = session.refused().first_key_value() {
        return gap(fault.to_string(), address, None);
    }
    if let Some((&address, access)) = session.undefined().first_key_value() {
        let what = format!("a register of {} that the manual does not have", access.instance);
        return gap(what, address, place(access.program_counter));
    }
    if let Some((instance, number)) = session.unrouted().first() {
        let what = format!("interrupt {number} of {instance}, which leads nowhere");
        return Some(Gap { what, address: None, place: None });
    }
    let told = session.told().next()?;
    Some(Gap { what: format!("{}.{}: {}", told.instance, told.register, told.reason), address: None, place: None })
}
