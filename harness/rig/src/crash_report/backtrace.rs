//! Finds the exception frame and the callers on the stack of a stopped processor. A word on the
//! stack counts as a return address if it is odd, lies in a function and follows a BL or BLX
//! instruction. This needs no call frame information and works on an overflowed stack. A return
//! address that an earlier call left on the stack also counts.

use crate::symbols::{CodeLocation, Symbols};

const MAX_CALLERS: usize = 6;
pub(crate) const MAX_STACK_WORDS: usize = 4_096;
/// Values of the link register from this one on are exception returns (B1.5.8).
const EXCEPTION_RETURN: u32 = 0xFFFF_FFE0;
/// Bit of an exception return that is set if the process stack was in use.
const RETURN_TO_PSP: u32 = 1 << 2;
/// Thumb bit of the stacked program status, which is set in every valid frame.
const XPSR_THUMB: u32 = 1 << 24;
const FRAME_BYTES: u32 = 32;

pub(crate) trait StackReader {
    /// Returns address and value of each readable word from `address` to the top of the stack.
    fn stack(&mut self, address: u32) -> Vec<(u32, u32)>;

    fn code(&self, address: u32) -> Option<u16>;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ExceptionFrame {
    pub(crate) pc: u32,
    pub(crate) lr: u32,
    pub(crate) end: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StoppedAt {
    /// At the handler's first instruction, when the link register contains the exception return.
    Entry,
    /// Later in the handler, which may have pushed the exception return below the frame.
    #[cfg(feature = "probe")]
    Body,
}

pub(crate) fn exception_frame(
    memory: &mut dyn StackReader,
    stopped: StoppedAt,
    [lr, sp, psp]: [u32; 3],
) -> Option<ExceptionFrame> {
    let at_entry = [(sp, lr)].into_iter().filter(|(_, lr)| is_exception_return(*lr));
    let pushed: Vec<_> = match stopped {
        StoppedAt::Entry => Vec::new(),
        #[cfg(feature = "probe")]
        StoppedAt::Body => {
            let stack = memory.stack(sp).into_iter();
            stack.filter(|(_, word)| is_exception_return(*word)).map(|(at, word)| (at + 4, word)).collect()
        }
    };
    pushed.into_iter().chain(at_entry).find_map(|(main, exception_return)| {
        let start = if exception_return & RETURN_TO_PSP == 0 { main } else { psp };
        let frame = memory.stack(start);
        let word =
            |index: u32| frame.get(index as usize).filter(|(at, _)| *at == start + 4 * index).map(|&(_, word)| word);
        let (lr, pc, xpsr) = (word(5)?, word(6)?, word(7)?);
        (xpsr & XPSR_THUMB != 0).then_some(ExceptionFrame { pc, lr, end: start + FRAME_BYTES })
    })
}

fn is_exception_return(word: u32) -> bool {
    (EXCEPTION_RETURN..u32::MAX).contains(&word)
}

/// Returns the callers of a function with return address `lr` and stack pointer `sp`, innermost
/// first. If `in_panic` is true, omits the calls from the panicking function to the panic handler.
pub(crate) fn callers(
    memory: &mut dyn StackReader,
    symbols: &Symbols,
    lr: Option<u32>,
    sp: u32,
    in_panic: bool,
) -> Vec<CodeLocation> {
    let stack = memory.stack(sp);
    let words = lr.into_iter().chain(stack.into_iter().map(|(_, word)| word));
    let mut returns: Vec<u32> = words.filter(|&word| is_return(memory, symbols, word)).take(2 * MAX_CALLERS).collect();
    returns.dedup();
    let mut calls: Vec<_> = returns.into_iter().map(|at| symbols.locate((at & !1) - 2)).collect();
    if in_panic {
        let own = calls.iter().position(is_firmware_code).unwrap_or(0);
        calls.drain(..own);
    }
    calls.dedup_by(|a, b| a.symbol == b.symbol);
    calls.truncate(MAX_CALLERS);
    calls
}

fn is_firmware_code(place: &CodeLocation) -> bool {
    place.symbol.as_deref().is_some_and(|symbol| !symbol.starts_with("core::") && !symbol.contains("panic"))
}

fn is_return(memory: &dyn StackReader, symbols: &Symbols, word: u32) -> bool {
    let at = word & !1;
    let half = |back: u32| at.checked_sub(back).and_then(|at| memory.code(at)).unwrap_or(0);
    // The preceding code is BL or BLX with an offset (A7.7.18), or BLX with a register (A7.7.19).
    word & 1 == 1
        && symbols.is_code(u64::from(at.saturating_sub(2)))
        && (half(4) >> 11 == 0b11110 && half(2) >> 14 == 0b11 || half(2) & 0xFF87 == 0x4780)
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
        let found = Some(ExceptionFrame { pc: PC, lr: LR, end: 0x2000_0030 });
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0010, 0, XPSR_THUMB), found);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_ffed, 0, 0x2000_0010, XPSR_THUMB), found);
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0010, 0, 0), None, "no Thumb bit");
        assert_eq!(frame(StoppedAt::Entry, 7, LR, 0x2000_0010, 0, XPSR_THUMB), None, "no exception return");
        assert_eq!(frame(StoppedAt::Entry, 7, 0xffff_fff9, 0x2000_0020, 0, XPSR_THUMB), None, "end of memory");
        #[cfg(feature = "probe")]
        for exception_return in [0xffff_fff9, 0xffff_ffe9] {
            assert_eq!(frame(StoppedAt::Body, exception_return, LR, 0x2000_0000, 0, XPSR_THUMB), found);
            assert_eq!(frame(StoppedAt::Body, 7, exception_return, 0x2000_0010, 0, XPSR_THUMB), found, "not pushed");
        }
        #[cfg(feature = "probe")]
        assert_eq!(frame(StoppedAt::Body, 0xffff_fffd, LR, 0x2000_0000, 0x2000_0010, XPSR_THUMB), found);
    }
}
