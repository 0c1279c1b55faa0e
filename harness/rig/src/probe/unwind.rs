//! Callers of an address: from frame to frame by the image's call frame information, through exception entries by what the processor stacked.
//!
//! Where there is no information, the list ends and says why. The one exception is the innermost frame: it may be a function in assembler that has
//! stacked nothing, whose caller is then in the link register.

use crate::symbols::{Slice, Symbols};
use gimli::{BaseAddresses, CfaRule, DebugFrame, Register, RegisterRule, UnwindContext, UnwindSection};

/// More frames than that are a loop in the stack.
const MOST_FRAMES: usize = 64;
const SP: usize = 13;
const LR: usize = 14;
const PC: usize = 15;
/// An exception's link register says in this bit which stack was in use, and here that floating-point registers were not stacked.
const RETURN_TO_PSP: u32 = 1 << 2;
const RETURN_BASIC_FRAME: u32 = 1 << 4;
const XPSR_THUMB: u32 = 1 << 24;
const XPSR_PADDED: u32 = 1 << 9;

/// The core registers of a stopped processor.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Registers {
    /// R0 to R12, SP, LR, PC.
    pub core: [u32; 16],
    /// The process stack pointer.
    pub psp: u32,
}

/// What the processor stacked when it took an exception.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StackedFrame {
    /// Where it was.
    pub pc: u32,
    /// Where it would have returned to.
    pub lr: u32,
    /// Program status.
    pub xpsr: u32,
}

/// The way back from where the processor was stopped.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Unwound {
    /// Code addresses from the innermost outwards.
    pub calls: Vec<u32>,
    /// The first exception entry met on the way, and its place in `calls`.
    pub entry: Option<(usize, StackedFrame)>,
    /// Why the list ends.
    pub end: &'static str,
}

/// Follows the stack; `read` reads a word of the target's memory.
pub(super) fn unwind(symbols: &Symbols, from: &Registers, mut read: impl FnMut(u32) -> Option<u32>) -> Unwound {
    let frames = symbols.frames();
    let mut registers = *from;
    let mut unwound = Unwound { end: "the list of callers was cut", ..Unwound::default() };
    // A stacked or interrupted address is that of the next instruction to run, a return address that behind the call.
    let mut returned = false;
    while unwound.calls.len() < MOST_FRAMES {
        let pc = registers.core[PC] & !1;
        unwound.calls.push(pc);
        let innermost = unwound.calls.len() == 1;
        let back = match step(&frames, &mut registers, pc - u32::from(returned && pc > 0), &mut read) {
            Step::Caller(back) => back,
            Step::Outermost => {
                unwound.end = "that is the outermost frame";
                break;
            }
            Step::Unreadable => {
                unwound.end = "the stack cannot be read";
                break;
            }
            Step::Unknown if innermost => registers.core[LR],
            Step::Unknown => {
                unwound.end = "the image has no call frame information for this";
                break;
            }
        };
        if back >= 0xffff_ffe0 {
            let Some(frame) = leave_exception(&mut registers, back, &mut read) else {
                unwound.end = "no exception frame on the stack";
                break;
            };
            unwound.entry.get_or_insert((unwound.calls.len(), frame));
            returned = false;
            continue;
        }
        if back == 0 || back == u32::MAX {
            unwound.end = "that is the outermost frame";
            break;
        }
        registers.core[PC] = back;
        returned = true;
    }
    unwound
}

enum Step {
    Caller(u32),
    Outermost,
    Unreadable,
    Unknown,
}

fn step(
    frames: &DebugFrame<Slice>,
    registers: &mut Registers,
    pc: u32,
    read: &mut impl FnMut(u32) -> Option<u32>,
) -> Step {
    let mut context = UnwindContext::new();
    let find = |section: &DebugFrame<_>, bases: &BaseAddresses, offset| section.cie_from_offset(bases, offset);
    let bases = BaseAddresses::default();
    let Ok(row) = frames.unwind_info_for_address(&bases, &mut context, u64::from(pc), find) else {
        return Step::Unknown;
    };
    let CfaRule::RegisterAndOffset { register, offset } = *row.cfa() else { return Step::Unknown };
    let Some(base) = registers.core.get(usize::from(register.0)) else { return Step::Unknown };
    let cfa = base.wrapping_add(offset as u32);
    let before = registers.core;
    for number in 0..=14_u16 {
        let index = usize::from(number);
        match row.register(Register(number)) {
            Some(RegisterRule::Offset(offset)) => match read(cfa.wrapping_add(offset as u32)) {
                Some(value) => registers.core[index] = value,
                None => return Step::Unreadable,
            },
            Some(RegisterRule::Undefined) if index == LR => return Step::Outermost,
            _ => registers.core[index] = before[index],
        }
    }
    registers.core[SP] = cfa;
    Step::Caller(registers.core[LR])
}

/// Takes back what the processor stacked at an exception's entry.
fn leave_exception(
    registers: &mut Registers,
    exception_return: u32,
    read: &mut impl FnMut(u32) -> Option<u32>,
) -> Option<StackedFrame> {
    let on_psp = exception_return & RETURN_TO_PSP != 0;
    let at = if on_psp { registers.psp } else { registers.core[SP] };
    let mut word = |index: u32| read(at.wrapping_add(4 * index));
    for (index, register) in [0, 1, 2, 3, 12, LR, PC].into_iter().enumerate() {
        registers.core[register] = word(index as u32)?;
    }
    let xpsr = word(7)?;
    // Without the Thumb bit these eight words are something else.
    if xpsr & XPSR_THUMB == 0 {
        return None;
    }
    let basic = exception_return & RETURN_BASIC_FRAME != 0;
    let size = if basic { 0x20 } else { 0x68 } + if xpsr & XPSR_PADDED == 0 { 0 } else { 4 };
    registers.core[SP] = at.wrapping_add(size);
    Some(StackedFrame { pc: registers.core[PC] & !1, lr: registers.core[LR], xpsr })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stack of words at `0x2000_0000` that holds an exception frame `at` so many words.
    fn leave(exception_return: u32, at: usize, xpsr: u32) -> (Registers, Option<StackedFrame>) {
        let mut stack = vec![0; 64];
        stack[at..at + 8].copy_from_slice(&[1, 2, 3, 4, 12, 0x0800_0101, 0x0800_0200, xpsr]);
        let mut registers = Registers { psp: 0x2000_0010, ..Registers::default() };
        registers.core[SP] = 0x2000_0020;
        let mut read = |address: u32| stack.get((address - 0x2000_0000) as usize / 4).copied();
        let frame = leave_exception(&mut registers, exception_return, &mut read);
        (registers, frame)
    }

    #[test]
    fn the_exception_return_says_which_stack_and_how_much_was_stacked() {
        for (exception_return, at, xpsr, sp) in [
            (0xffff_fff9, 8, XPSR_THUMB, 0x2000_0040),
            (0xffff_fffd, 4, XPSR_THUMB, 0x2000_0030),
            (0xffff_ffe9, 8, XPSR_THUMB, 0x2000_0088),
            (0xffff_ffed, 4, XPSR_THUMB | XPSR_PADDED, 0x2000_007c),
        ] {
            let (registers, frame) = leave(exception_return, at, xpsr);
            assert_eq!(frame, Some(StackedFrame { pc: 0x0800_0200, lr: 0x0800_0101, xpsr }));
            assert_eq!(registers.core[SP], sp, "{exception_return:#x}");
            assert_eq!(registers.core[12], 12);
        }
    }

    #[test]
    fn words_without_the_thumb_bit_are_no_exception_frame() {
        assert_eq!(leave(0xffff_fff9, 8, 0).1, None);
    }
}
