//! Reports a crash of the firmware from the fault status registers CFSR and HFSR and the fault
//! address registers MMFAR and BFAR (ARMv7-M Architecture Reference Manual, B1.5 and B3.2).

mod backtrace;

pub(crate) use backtrace::{
    CallChain, MAX_STACK_WORDS, StackReader, StoppedAt, call_chain, calls_before_overflow, calls_before_panic,
    exception_frame,
};

use crate::symbols::CodeLocation;
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

impl fmt::Display for CrashReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "the firmware trapped: {}", self.exception)?;
        for cause in self.status.causes() {
            write!(formatter, ", {cause}")?;
        }
        if let Some(place) = &self.place {
            write!(formatter, ", at {place}")?;
        }
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
