//! A trap, read from the processor.
//!
//! Nothing here stops the processor before its own handler has run: that handler takes the drive to 0 V. The fault registers are read while it runs; it
//! is halted only for its core registers. The chip's watchdog goes on all the while and may reset the chip in between; then that is said.

use super::error::ProbeError;
use super::image::Image;
use super::unwind::{Registers, StackedFrame, unwind};
use crate::symbols::Place;
use probe_rs::{Core, MemoryInterface, RegisterId};
use std::fmt;
use std::time::Duration;

const ICSR: u64 = 0xe000_ed04;
const CFSR: u64 = 0xe000_ed28;
const HFSR: u64 = 0xe000_ed2c;
const MMFAR: u64 = 0xe000_ed34;
const BFAR: u64 = 0xe000_ed38;
const DHCSR: u64 = 0xe000_edf0;
const LOCKED_UP: u32 = 1 << 19;
const MMFAR_VALID: u32 = 1 << 7;
const BFAR_VALID: u32 = 1 << 15;
const PSP: RegisterId = RegisterId(18);
/// What halting may take; the processor stops within some cycles or never.
const HALT: Duration = Duration::from_millis(100);

/// Bits of the configurable fault status register, as the architecture manual has them.
const CAUSES: [(u32, &str); 16] = [
    (1 << 0, "instruction fetch from a forbidden address"),
    (1 << 1, "data access to a forbidden address"),
    (1 << 3, "memory fault on leaving an exception"),
    (1 << 4, "memory fault on entering an exception: stack overflow"),
    (1 << 5, "memory fault while stacking floating-point registers"),
    (1 << 8, "instruction fetch from an address that does not answer"),
    (1 << 9, "data access to an address that does not answer"),
    (1 << 10, "data access to an address that does not answer, some instructions earlier"),
    (1 << 11, "bus fault on leaving an exception"),
    (1 << 12, "bus fault on entering an exception: stack overflow"),
    (1 << 13, "bus fault while stacking floating-point registers"),
    (1 << 16, "undefined instruction"),
    (1 << 17, "jump to an address that is no Thumb code"),
    (1 << 18, "invalid exception return"),
    (1 << 19, "coprocessor or floating-point unit switched off"),
    (1 << 24, "unaligned access"),
];
const DIVISION: u32 = 1 << 25;

/// Which handler the processor is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trap {
    /// Exception 3.
    HardFault,
    /// Exception 4.
    MemManage,
    /// Exception 5.
    BusFault,
    /// Exception 6.
    UsageFault,
    /// A fault within a fault handler: the processor has stopped for good.
    Lockup,
}

/// A processor trap with everything that is left of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Which handler.
    pub trap: Trap,
    /// Configurable fault status register.
    pub cfsr: u32,
    /// `HardFault` status register.
    pub hfsr: u32,
    /// The address that was accessed, where the processor kept it.
    pub address: Option<u32>,
    /// What was stacked on entry, where it was found.
    pub frame: Option<StackedFrame>,
    /// The faulting instruction first, then its callers.
    pub backtrace: Vec<Place>,
    /// Why the backtrace ends.
    pub end: &'static str,
    /// The watchdog reset the chip while it was read: what follows the status registers is missing.
    pub reset_meanwhile: bool,
}

impl Fault {
    /// What happened, in words, from the status registers.
    pub fn causes(&self) -> Vec<&'static str> {
        let division = [(DIVISION, "division by zero")];
        let mut causes: Vec<_> =
            CAUSES.iter().chain(&division).filter(|(bit, _)| self.cfsr & bit != 0).map(|&(_, text)| text).collect();
        if self.hfsr & 1 << 1 != 0 {
            causes.push("the vector table cannot be read");
        }
        if self.hfsr & 1 << 31 != 0 {
            causes.push("breakpoint instruction without a debugger");
        }
        causes
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.trap {
            Trap::Lockup => formatter.write_str("the processor locked up")?,
            trap => write!(formatter, "the processor is in its {trap:?} handler")?,
        }
        let causes = self.causes();
        write!(formatter, ": {}", if causes.is_empty() { "no cause recorded".to_owned() } else { causes.join(", ") })?;
        if let Some(address) = self.address {
            write!(formatter, ", address {address:#010x}")?;
        }
        if let Some(place) = self.backtrace.first() {
            let at = if self.frame.is_some() { "at" } else { "in the handler at" };
            write!(formatter, ", {at} {place}")?;
        }
        write!(formatter, "; cfsr {:#010x}, hfsr {:#010x}", self.cfsr, self.hfsr)?;
        if let Some(frame) = self.frame {
            write!(formatter, ", stacked pc {:#010x}, lr {:#010x}", frame.pc, frame.lr)?;
        }
        for place in self.backtrace.iter().skip(1) {
            write!(formatter, "\n  called from {place}")?;
        }
        if self.reset_meanwhile {
            return formatter.write_str("\n  the watchdog reset the chip while it was read");
        }
        write!(formatter, "\n  ({})", self.end)
    }
}

/// Looks whether the processor is in a fault handler, and reads what there is if so.
pub(super) fn inspect(core: &mut Core<'_>, image: &Image) -> Result<Option<Fault>, ProbeError> {
    let Some(trap) = trapped(core)? else { return Ok(None) };
    let word = |core: &mut Core<'_>, address| core.read_word_32(address).map_err(ProbeError::line("reading a fault"));
    let cfsr = word(core, CFSR)?;
    let hfsr = word(core, HFSR)?;
    let address = match (cfsr & MMFAR_VALID != 0, cfsr & BFAR_VALID != 0) {
        (true, _) => Some(word(core, MMFAR)?),
        (false, true) => Some(word(core, BFAR)?),
        (false, false) => None,
    };
    let mut fault = Fault {
        trap,
        cfsr,
        hfsr,
        address,
        frame: None,
        backtrace: Vec::new(),
        end: "the stack was not read",
        reset_meanwhile: false,
    };
    core.halt(HALT).map_err(ProbeError::line("halting the processor"))?;
    let registers = read_registers(core)?;
    let symbols = image.symbols();
    let unwound = unwind(&symbols, &registers, |address| core.read_word_32(u64::from(address)).ok());
    let skip = unwound.entry.map_or(0, |(index, _)| index);
    fault.frame = unwound.entry.map(|(_, frame)| frame);
    fault.end = unwound.end;
    fault.backtrace = unwound.calls.into_iter().skip(skip).map(|address| symbols.place(address)).collect();
    if trapped(core)? != Some(trap) {
        fault.frame = None;
        fault.backtrace.clear();
        fault.reset_meanwhile = true;
    }
    Ok(Some(fault))
}

fn trapped(core: &mut Core<'_>) -> Result<Option<Trap>, ProbeError> {
    let state = core.read_word_32(DHCSR).map_err(ProbeError::line("looking for a fault"))?;
    if state & LOCKED_UP != 0 {
        return Ok(Some(Trap::Lockup));
    }
    let active = core.read_word_32(ICSR).map_err(ProbeError::line("looking for a fault"))? & 0x1ff;
    Ok(match active {
        3 => Some(Trap::HardFault),
        4 => Some(Trap::MemManage),
        5 => Some(Trap::BusFault),
        6 => Some(Trap::UsageFault),
        _ => None,
    })
}

fn read_registers(core: &mut Core<'_>) -> Result<Registers, ProbeError> {
    let mut registers = Registers::default();
    for (number, register) in (0..).zip(&mut registers.core) {
        *register = read_register(core, RegisterId(number))?;
    }
    registers.psp = read_register(core, PSP)?;
    Ok(registers)
}

fn read_register(core: &mut Core<'_>, register: RegisterId) -> Result<u32, ProbeError> {
    core.read_core_reg(register).map_err(ProbeError::line("reading a core register"))
}
