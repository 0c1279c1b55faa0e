//! Reports a crash of the firmware from the fault status registers CFSR and HFSR and the fault
//! address registers MMFAR and BFAR (ARMv7-M Architecture Reference Manual, B1.5 and B3.2).
//!
//! Finds the exception frame and the callers of the stopped processor. Callers follow from the image's
//! call frame information. A return address that an earlier call left on the stack never counts.

use crate::symbols::{CodeLocation, FrameRegisters, Symbols};
use std::fmt;

#[cfg(feature = "probe")]
pub(crate) const ICSR: u64 = 0xE000_ED04;
const CFSR: u64 = 0xE000_ED28;
const HFSR: u64 = 0xE000_ED2C;
const MMFAR: u64 = 0xE000_ED34;
const BFAR: u64 = 0xE000_ED38;

/// Bits of CFSR that mark a valid address in MMFAR or BFAR.
const MMFAR_VALID: u32 = 1 << 7;
const BFAR_VALID: u32 = 1 << 15;
/// Bits of CFSR that are set if the processor could not push its registers to the stack.
const STACKING_FAILED: u32 = 1 << 12 | 1 << 4;

/// Bits of CFSR and their causes (B3.2.15).
const CAUSES: [(u32, &str); 17] = [
    (0, "instruction access violation"),
    (1, "data access violation"),
    (3, "access violation while unstacking"),
    (4, "access violation while stacking"),
    (5, "access violation while stacking floats"),
    (8, "instruction bus error"),
    (9, "data bus error"),
    (10, "imprecise data bus error"),
    (11, "bus error while unstacking"),
    (12, "bus error while stacking"),
    (13, "bus error while stacking floats"),
    (16, "undefined instruction"),
    (17, "invalid state"),
    (18, "invalid return address"),
    (19, "no such coprocessor"),
    (24, "unaligned access"),
    (25, "division by zero"),
];
/// Bits of HFSR for causes that CFSR does not contain (B3.2.16).
const HARD_CAUSES: [(u32, &str); 2] = [(1, "vector table not readable"), (31, "breakpoint without a debugger")];

const EXCEPTIONS: [(u32, &str); 5] =
    [(2, "NMI"), (3, "HardFault"), (4, "MemManage"), (5, "BusFault"), (6, "UsageFault")];

pub(crate) fn fault_handler(number: u32) -> Option<&'static str> {
    EXCEPTIONS.iter().find(|(other, _)| *other == number).map(|&(_, name)| name)
}

pub(crate) fn fault_handlers() -> impl Iterator<Item = u32> {
    EXCEPTIONS.iter().map(|&(number, _)| number)
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FaultStatus {
    pub cfsr: u32,
    pub hfsr: u32,
    /// Address of the failed data access, if the processor kept it.
    pub address: Option<u32>,
}

impl FaultStatus {
    pub(crate) fn read<E>(mut word: impl FnMut(u64) -> Result<u32, E>) -> Result<Self, E> {
        let (cfsr, hfsr) = (word(CFSR)?, word(HFSR)?);
        let register = if cfsr & BFAR_VALID != 0 { Some(BFAR) } else { (cfsr & MMFAR_VALID != 0).then_some(MMFAR) };
        Ok(Self { cfsr, hfsr, address: register.map(word).transpose()? })
    }

    pub fn causes(&self) -> Vec<&'static str> {
        let set = |table: &'static [(u32, &'static str)], bits: u32| {
            table.iter().filter(move |(bit, _)| bits & 1 << bit != 0).map(|&(_, cause)| cause)
        };
        set(&CAUSES, self.cfsr).chain(set(&HARD_CAUSES, self.hfsr)).collect()
    }

    pub fn is_stacking_failure(&self) -> bool {
        self.cfsr & STACKING_FAILED != 0
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CrashReport {
    /// Name such as `HardFault`, `lockup` or `panic`.
    pub exception: &'static str,
    pub status: FaultStatus,
    /// The failed instruction, or the innermost known call.
    pub place: Option<CodeLocation>,
    /// Innermost first, by the call frame information of the image. Ends at the first function
    /// without it.
    pub callers: Vec<CodeLocation>,
    /// The call before the return address in the link register, if no caller is known. It has
    /// returned if the function at `place` has called another one.
    pub link: Option<CodeLocation>,
    /// The peripheral or memory at the failed address.
    pub address_owner: Option<&'static str>,
    pub sp: u32,
    /// Time since power-on, if the rig knows it.
    pub at_us: Option<u64>,
    /// True if the watchdog reset the chip during the reading, so that place and callers are
    /// missing.
    pub watchdog_reset: bool,
}

impl CrashReport {
    /// Exception, causes and place: equal for the same fault at the same place.
    pub fn cause(&self) -> String {
        let causes = self.status.causes().into_iter().map(|cause| format!(", {cause}"));
        let place = self.place.iter().map(|place| format!(", at {place}"));
        format!("the firmware trapped: {}{}", self.exception, causes.chain(place).collect::<String>())
    }
}

impl fmt::Display for CrashReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.cause())?;
        if let Some(address) = self.status.address {
            write!(formatter, ", address {address:#010x}")?;
            self.address_owner.map_or(Ok(()), |owner| write!(formatter, " ({owner})"))?;
        }
        if self.status.is_stacking_failure() {
            write!(formatter, ", stack pointer {:#010x}: the stack overflowed", self.sp)?;
        }
        for (index, call) in self.callers.iter().enumerate() {
            write!(formatter, "{}{call}", if index == 0 { "; called from " } else { ", from " })?;
        }
        if let Some(link) = &self.link {
            write!(formatter, "; callers unknown, the link register has the return address of the call at {link}")?;
        }
        write!(formatter, "; cfsr {:#010x}, hfsr {:#010x}", self.status.cfsr, self.status.hfsr)?;
        self.at_us.map_or(Ok(()), |at_us| write!(formatter, ", {at_us} µs after power-on"))?;
        if self.watchdog_reset {
            formatter.write_str("; the watchdog reset the chip before its stack was read")?;
        }
        Ok(())
    }
}

const MAX_CALLERS: usize = 6;
/// Longest chain of calls and exceptions that is followed.
const MAX_STEPS: usize = 64;
pub(crate) const MAX_STACK_WORDS: usize = 4_096;
/// Values of the link register from this one on are exception returns (B1.5.8).
const EXCEPTION_RETURN: u32 = 0xFFFF_FFE0;
/// Bit of an exception return that is set if the process stack was in use.
const RETURN_TO_PSP: u32 = 1 << 2;
/// Bit of an exception return that is set if the frame contains no floating-point registers.
const BASIC_FRAME: u32 = 1 << 4;
/// Thumb bit of the stacked program status. It is clear only after a jump to an even address.
const XPSR_THUMB: u32 = 1 << 24;
/// Bit of the stacked program status that is set if a word before the frame aligns the stack.
const XPSR_ALIGNED: u32 = 1 << 9;
const BASIC_FRAME_BYTES: u32 = 32;
const EXTENDED_FRAME_BYTES: u32 = 104;
/// Frame pointer of code that keeps one. It points to the caller's frame pointer and the return
/// address.
const FRAME_POINTER: u16 = 7;

pub(crate) trait StackReader {
    /// Returns address and value of each readable word from `address` to the top of the stack.
    fn stack(&mut self, address: u32) -> Vec<(u32, u32)>;

    fn code(&self, address: u32) -> Option<u16>;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ExceptionFrame {
    pub(crate) pc: u32,
    pub(crate) lr: u32,
    /// Stack pointer of the interrupted code.
    pub(crate) end: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StoppedAt {
    /// At the handler's first instruction, when the link register contains the exception return.
    Entry,
    /// Later in the handler, which may have pushed the exception return below the frame.
    Body,
}

/// `lr`, `sp` and `psp` are those of the handler.
pub(crate) fn exception_frame(
    memory: &mut dyn StackReader,
    stopped: StoppedAt,
    [lr, sp, psp]: [u32; 3],
) -> Option<ExceptionFrame> {
    if stopped == StoppedAt::Entry {
        let start = frame_start(lr, sp, psp);
        let frame = decode_frame(&memory.stack(start), start, lr);
        return frame.filter(|_| is_exception_return(lr)).map(|(frame, _)| frame);
    }
    let stack = memory.stack(sp).into_iter();
    let pushed = stack.filter(|(_, word)| is_exception_return(*word)).map(|(at, word)| (at + 4, word));
    let at_entry = Some((sp, lr)).filter(|(_, lr)| is_exception_return(*lr));
    pushed.chain(at_entry).find_map(|(main, exception_return)| {
        let start = frame_start(exception_return, main, psp);
        // The Thumb bit tells a frame from other words.
        let (frame, xpsr) = decode_frame(&memory.stack(start), start, exception_return)?;
        (xpsr & XPSR_THUMB != 0).then_some(frame)
    })
}

fn is_exception_return(word: u32) -> bool {
    (EXCEPTION_RETURN..u32::MAX).contains(&word)
}

const fn frame_start(exception_return: u32, main: u32, psp: u32) -> u32 {
    if exception_return & RETURN_TO_PSP == 0 { main } else { psp }
}

fn word_at(stack: &[(u32, u32)], address: u32) -> Option<u32> {
    let index = stack.binary_search_by_key(&address, |&(at, _)| at).ok()?;
    stack.get(index).map(|&(_, word)| word)
}

/// Returns the frame (B1.5.6) at `start` and its program status.
fn decode_frame(stack: &[(u32, u32)], start: u32, exception_return: u32) -> Option<(ExceptionFrame, u32)> {
    let word = |index: u32| word_at(stack, start.checked_add(4 * index)?);
    let (lr, pc, xpsr) = (word(5)?, word(6)?, word(7)?);
    let bytes = if exception_return & BASIC_FRAME == 0 { EXTENDED_FRAME_BYTES } else { BASIC_FRAME_BYTES };
    let padding = if xpsr & XPSR_ALIGNED == 0 { 0 } else { 4 };
    Some((ExceptionFrame { pc, lr, end: start.checked_add(bytes + padding)? }, xpsr))
}

/// The calls that led to an instruction.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct CallChain {
    /// Innermost first. Ends at the first function whose caller is unknown.
    pub(crate) callers: Vec<CodeLocation>,
    /// The call before the return address in the link register, if no caller is known. It has
    /// returned if the function has called another one.
    pub(crate) link: Option<CodeLocation>,
}

/// Returns the calls that led to the instruction at `pc`. `registers` are those at this
/// instruction.
pub(crate) fn call_chain(
    memory: &mut dyn StackReader,
    symbols: &Symbols,
    pc: u32,
    registers: FrameRegisters,
) -> CallChain {
    let stack = memory.stack(registers.sp);
    let is_outside_code = !symbols.is_code(u64::from(pc));
    let returns_to = registers.lr.filter(|&lr| is_return(memory, symbols, lr));
    // No code at `pc` has changed the link register, so the call before its address jumped here.
    if let Some(lr) = returns_to.filter(|&lr| is_outside_code && is_register_call(memory, lr)) {
        let mut calls = vec![call_address(lr)];
        follow(memory, symbols, &stack, call_address(lr), FrameRegisters { lr: None, ..registers }, &mut calls);
        return CallChain { callers: locate_calls(symbols, &calls), link: None };
    }
    let mut calls = Vec::new();
    follow(memory, symbols, &stack, pc, registers, &mut calls);
    let link = returns_to.filter(|_| calls.is_empty()).map(|lr| symbols.locate(call_address(lr)));
    CallChain { callers: locate_calls(symbols, &calls), link }
}

/// Returns the calls of the panicking function, whose last one is the panic. `registers` are those
/// at the first instruction of the panic handler, at `pc`.
pub(crate) fn calls_before_panic(
    memory: &mut dyn StackReader,
    symbols: &Symbols,
    pc: u32,
    registers: FrameRegisters,
) -> Vec<CodeLocation> {
    let CallChain { mut callers, link } = call_chain(memory, symbols, pc, registers);
    // At its first instruction, the handler has not called another function.
    callers.extend(link);
    let own = callers.iter().position(is_firmware_code).unwrap_or(0);
    callers.drain(..own);
    callers
}

/// Returns the calls after an overflow of the stack, when the processor could not store where it
/// was. Only the frame pointer shows them, so the list is empty for code without one.
pub(crate) fn calls_before_overflow(
    memory: &mut dyn StackReader,
    symbols: &Symbols,
    registers: FrameRegisters,
) -> Vec<CodeLocation> {
    let stack = memory.stack(registers.sp);
    let Some(frame) = registers.get(FRAME_POINTER).filter(|&frame| frame >= registers.sp) else { return Vec::new() };
    let caller_frame = word_at(&stack, frame);
    let (Some(sp), Some(returns_to)) = (frame.checked_add(8), frame.checked_add(4).and_then(|at| word_at(&stack, at)))
    else {
        return Vec::new();
    };
    if !is_return(memory, symbols, returns_to) {
        return Vec::new();
    }
    let mut saved = [None; 8];
    if let Some(slot) = saved.get_mut(usize::from(FRAME_POINTER - 4)) {
        *slot = caller_frame;
    }
    let call = call_address(returns_to);
    let registers = FrameRegisters { sp, lr: None, saved };
    // If this function keeps a frame pointer, the register is one in the whole program.
    let caller = symbols.call_frames().caller(call, &registers, |address| word_at(&stack, address));
    if caller.is_none_or(|caller| caller.base != FRAME_POINTER) {
        return Vec::new();
    }
    let mut calls = vec![call];
    follow(memory, symbols, &stack, call, registers, &mut calls);
    locate_calls(symbols, &calls)
}

/// Appends the addresses of the calls that led to the instruction at `pc`.
fn follow(
    memory: &dyn StackReader,
    symbols: &Symbols,
    stack: &[(u32, u32)],
    mut pc: u32,
    mut registers: FrameRegisters,
    calls: &mut Vec<u32>,
) {
    let word = |address| word_at(stack, address);
    for _ in 0..MAX_STEPS {
        let Some(caller) = symbols.call_frames().caller(pc, &registers, word) else { break };
        // Only a function without a frame of its own leaves the stack pointer unchanged.
        if caller.registers.sp < registers.sp || (caller.registers.sp == registers.sp && registers.lr.is_none()) {
            break;
        }
        if is_exception_return(caller.return_address) {
            // A handler interrupted this code. Only frames on the main stack are followed.
            let exception_return = caller.return_address;
            let frame = (exception_return & RETURN_TO_PSP == 0)
                .then(|| decode_frame(stack, caller.registers.sp, exception_return))
                .flatten();
            let Some((frame, _)) = frame else { break };
            calls.push(frame.pc);
            pc = frame.pc;
            registers = FrameRegisters { sp: frame.end, lr: Some(frame.lr), ..caller.registers };
            continue;
        }
        if !is_return(memory, symbols, caller.return_address) {
            break;
        }
        pc = call_address(caller.return_address);
        calls.push(pc);
        registers = caller.registers;
    }
}

fn locate_calls(symbols: &Symbols, calls: &[u32]) -> Vec<CodeLocation> {
    let mut calls: Vec<_> = calls.iter().map(|&call| symbols.locate(call)).collect();
    calls.dedup_by(|a, b| a.symbol == b.symbol);
    calls.truncate(MAX_CALLERS);
    calls
}

fn is_firmware_code(place: &CodeLocation) -> bool {
    place.symbol.as_deref().is_some_and(|symbol| !symbol.starts_with("core::") && !symbol.contains("panic"))
}

/// Address of the last half-word of the call before a return address.
const fn call_address(returns_to: u32) -> u32 {
    (returns_to & !1).saturating_sub(2)
}

fn half_before(memory: &dyn StackReader, returns_to: u32, bytes: u32) -> u16 {
    (returns_to & !1).checked_sub(bytes).and_then(|at| memory.code(at)).unwrap_or(0)
}

/// True if the preceding code is BLX with a register (A7.7.19).
fn is_register_call(memory: &dyn StackReader, returns_to: u32) -> bool {
    half_before(memory, returns_to, 2) & 0xFF87 == 0x4780
}

fn is_return(memory: &dyn StackReader, symbols: &Symbols, word: u32) -> bool {
    let half = |back| half_before(memory, word, back);
    // The preceding code is BL or BLX with an offset (A7.7.18), or BLX with a register.
    word & 1 == 1
        && symbols.is_code(u64::from(call_address(word)))
        && (half(4) >> 11 == 0b11110 && half(2) >> 14 == 0b11 || is_register_call(memory, word))
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Stack(Vec<u32>);

    impl StackReader for Stack {
        fn stack(&mut self, address: u32) -> Vec<(u32, u32)> {
            let words = (0x2000_0000..).step_by(4).zip(self.0.iter().copied());
            words.filter(|(at, _)| *at >= address).collect()
        }

        fn code(&self, _address: u32) -> Option<u16> {
            None
        }
    }

    const PC: u32 = 0x0800_0200;
    const LR: u32 = 0x0800_0101;

    fn stack(exception_return: u32, xpsr: u32) -> Stack {
        Stack(vec![7, 7, 7, exception_return, 1, 2, 3, 4, 12, LR, PC, xpsr])
    }

    #[test]
    fn finds_the_exception_frame_at_entry_and_in_the_handler() {
        let frame = |stopped, exception_return, lr, sp, psp, xpsr| {
            exception_frame(&mut stack(exception_return, xpsr), stopped, [lr, sp, psp])
        };
        let ends_at = |end| Some(ExceptionFrame { pc: PC, lr: LR, end });
        let found = ends_at(0x2000_0030);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0010, 0, XPSR_THUMB), found);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fffd, 0, 0x2000_0010, XPSR_THUMB), found);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0010, 0, 0), found, "a jump to an even address");
        let aligned = XPSR_THUMB | XPSR_ALIGNED;
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0010, 0, aligned), ends_at(0x2000_0034));
        let with_floats = ends_at(0x2000_0010 + 26 * 4);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_ffed, 0, 0x2000_0010, XPSR_THUMB), with_floats);
        assert_eq!(frame(StoppedAt::Entry, 7, LR, 0x2000_0010, 0, XPSR_THUMB), None, "no exception return");
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0020, 0, XPSR_THUMB), None, "end of memory");
        for (exception_return, found) in [(0xffff_fff9, found), (0xffff_ffe9, with_floats)] {
            assert_eq!(frame(StoppedAt::Body, exception_return, LR, 0x2000_0000, 0, XPSR_THUMB), found);
            assert_eq!(frame(StoppedAt::Body, 7, exception_return, 0x2000_0010, 0, XPSR_THUMB), found, "not pushed");
            assert_eq!(frame(StoppedAt::Body, exception_return, LR, 0x2000_0000, 0, 0), None, "no Thumb bit");
        }
        assert_eq!(frame(StoppedAt::Body, 0xffff_fffd, LR, 0x2000_0000, 0x2000_0010, XPSR_THUMB), found);
    }
}
