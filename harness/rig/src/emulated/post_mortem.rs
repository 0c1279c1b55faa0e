//! Reads the state of an emulated board after a crash, a reset or an unsupported access.

use super::board::EmulatedBoard;
use super::bus::{SystemBus, UnmodelledAccess};
use super::image::{FLASH_START, Image};
use super::memory::Memory;
use crate::crash_report::{
    CallChain, CrashReport, FaultStatus, MAX_STACK_WORDS, StackReader, StoppedAt, call_chain, calls_before_overflow,
    calls_before_panic, exception_frame, fault_handler, fault_handlers,
};
use crate::link::UnsupportedAccess;
use crate::symbols::{FrameRegisters, Symbols};
use rigless::device::ResetCause;
use rigless::emulator::Processor;
use rigless::session::Session;
use rigless::soc::Width;
use std::convert::Infallible;

const R4: usize = 4;
const SP: usize = 13;
const LR: usize = 14;
const XPSR: usize = 16;
const PSP: usize = 35;

#[derive(Debug)]
pub(super) struct FaultHandlers {
    exceptions: Vec<u64>,
    panic: Option<u64>,
}

impl FaultHandlers {
    pub(super) fn none() -> Self {
        Self { exceptions: Vec::new(), panic: None }
    }

    pub(super) fn from_image(memory: &Memory, image: &Image) -> Self {
        let mut exceptions: Vec<_> = fault_handlers()
            .filter_map(|number| memory.word(FLASH_START + 4 * u64::from(number)))
            .filter(|&vector| vector != 0 && vector != u32::MAX)
            .map(|vector| u64::from(vector & !1))
            .collect();
        exceptions.sort_unstable();
        exceptions.dedup();
        Self { exceptions, panic: Symbols::read(&image.elf).panic_handler() }
    }

    /// Adds the handlers of the vector table at `table`, which the firmware may have moved or changed,
    /// and sets breakpoints on the new ones.
    pub(super) fn follow(&mut self, memory: &Memory, table: u64, core: &mut dyn Processor) {
        for number in fault_handlers() {
            let Some(vector) = memory.word(table + 4 * u64::from(number)) else { return };
            let handler = u64::from(vector & !1);
            if vector != 0 && vector != u32::MAX && !self.exceptions.contains(&handler) {
                self.exceptions.push(handler);
                core.add_breakpoint(handler);
            }
        }
    }

    pub(super) fn set_breakpoints(&self, core: &mut dyn Processor) {
        for &address in self.exceptions.iter().chain(&self.panic) {
            core.add_breakpoint(address);
        }
    }

    /// `None` if the processor is in no fault handler, or if another exception uses this handler.
    /// `stopped` states where in the handler it is.
    pub(super) fn read_crash(
        &self,
        stopped: StoppedAt,
        core: &mut dyn Processor,
        bus: &SystemBus,
        session: &mut Session<EmulatedBoard>,
        image: &Image,
    ) -> Option<CrashReport> {
        let is_entry = stopped == StoppedAt::Entry;
        let is_panic = is_entry && self.panic == Some(core.pc());
        let active = register(core, XPSR) & 0x1FF;
        let exception = if is_panic { "panic" } else { fault_handler(active)? };
        let now = bus.time_at(core.retired());
        let read = |address| Ok(core.debugger_access(None, address, Width::W32, now).unwrap_or(0) as u32);
        let Ok(status) = FaultStatus::read::<Infallible>(read);
        let symbols = Symbols::read(&image.elf);
        let (lr, sp) = (register(core, LR), register(core, SP));
        // At its first instruction, the handler has changed none of these registers.
        let saved = std::array::from_fn(|index| is_entry.then(|| register(core, R4 + index)));
        let at_entry = FrameRegisters { sp, lr: Some(lr), saved };
        let mut stack = EmulatedStack { memory: &bus.memory, top: image.initial_stack };
        let mut chain = CallChain::default();
        let mut place = None;
        if is_panic {
            chain.callers = calls_before_panic(&mut stack, &symbols, core.pc() as u32, at_entry);
        } else if status.is_stacking_failure() && is_entry {
            chain.callers = calls_before_overflow(&mut stack, &symbols, at_entry);
        } else if let Some(frame) = exception_frame(&mut stack, stopped, [lr, sp, register(core, PSP)]) {
            place = Some(symbols.locate(frame.pc));
            let interrupted = FrameRegisters { sp: frame.end, lr: Some(frame.lr), saved };
            chain = call_chain(&mut stack, &symbols, frame.pc, interrupted);
        }
        if place.is_none() && !chain.callers.is_empty() {
            place = Some(chain.callers.remove(0));
        }
        let owner = |address| session.board().part.instance_at(u64::from(address)).unwrap_or("nothing answers there");
        Some(CrashReport {
            exception,
            status,
            place,
            callers: chain.callers,
            link: chain.link,
            address_owner: status.address.map(owner),
            sp,
            at_us: Some(now.0 / 1_000),
            watchdog_reset: false,
        })
    }
}

fn register(core: &dyn Processor, number: usize) -> u32 {
    let bytes = core.gdb_register(number).unwrap_or_default();
    bytes.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

struct EmulatedStack<'a> {
    memory: &'a Memory,
    top: u32,
}

impl StackReader for EmulatedStack<'_> {
    fn stack(&mut self, address: u32) -> Vec<(u32, u32)> {
        // An overflowed stack begins below RAM. Words outside RAM are skipped.
        let addresses = (address..self.top).step_by(4).take(MAX_STACK_WORDS);
        addresses.filter_map(|at| Some((at, self.memory.word(u64::from(at))?))).collect()
    }

    fn code(&self, address: u32) -> Option<u16> {
        self.memory.value(u64::from(address), Width::W16).map(|value| value as u16)
    }
}

pub(super) fn reset_cause(cause: ResetCause) -> String {
    match cause {
        ResetCause::Model("IWDG") => "independent watchdog".to_owned(),
        ResetCause::Model("WWDG") => "window watchdog".to_owned(),
        ResetCause::Model(instance) => instance.to_owned(),
        ResetCause::Core => "request of the firmware".to_owned(),
        other => format!("{other:?}"),
    }
}

/// `bus` knows the instructions of accesses for which the emulator keeps none.
pub(super) fn first_unsupported_access(
    session: &Session<EmulatedBoard>,
    bus: &SystemBus,
    image: &Image,
) -> Option<UnsupportedAccess> {
    let place = |pc: u64| Some(Symbols::read(&image.elf).locate(pc as u32));
    let part = &session.board().part;
    let unsupported =
        |access, address: u64, place| Some(UnsupportedAccess { access, address: Some(address as u32), place });
    if let Some(UnmodelledAccess { what, address, instruction }) = &bus.unmodelled {
        return unsupported((*what).to_owned(), *address, instruction.and_then(place));
    }
    let doubtful = part.without_model.doubtful_read;
    let doubtful = doubtful.and_then(|(address, pc)| Some((address, pc, session.unimplemented().get(&address)?)));
    if let Some((address, pc, access)) = doubtful {
        let what = format!(
            "{}.{} read after a write to {0}, a board may return another value",
            access.instance, access.register
        );
        return unsupported(what, address, place(pc));
    }
    if let Some(access) = session.unmapped().first() {
        let what = format!("{}, no such register", part.instance_at(access.address).unwrap_or("memory"));
        return unsupported(what, access.address, place(access.program_counter));
    }
    let first_refused =
        bus.refused.first().and_then(|&(address, pc)| Some((address, pc, session.refused().get(&address)?)));
    if let Some((address, pc, fault)) = first_refused {
        return unsupported(fault.to_string(), address, place(pc));
    }
    if let Some((&address, fault)) = session.refused().first_key_value() {
        return unsupported(fault.to_string(), address, None);
    }
    let report = session.told().min_by_key(|told| told.at)?;
    let access = format!("{}.{}: {}", report.instance, report.register, report.reason);
    Some(UnsupportedAccess { access, address: None, place: bus.told_at.and_then(place) })
}
