//! Reads a crash of the firmware through the debug probe. The processor runs while its fault
//! handler takes the drive to 0 V. Then the bench halts it to read its core registers and stack.
//! The chip's watchdog may reset the processor meanwhile.

use super::error::ProbeError;
use super::image::Image;
use crate::call_frames::FrameRegisters;
use crate::crash_report::{
    CallChain, CrashReport, FaultStatus, ICSR, StackReader, StoppedAt, call_chain, exception_frame, fault_handler,
};
use probe_rs::{Core, MemoryInterface, RegisterId};
use std::time::Duration;

/// Debug Halting Control and Status Register, and its bit for a fault within a fault handler
/// (ARMv7-M ARM, C1.6.2).
const DHCSR: u64 = 0xE000_EDF0;
const LOCKED_UP: u32 = 1 << 19;
const SP: RegisterId = RegisterId(13);
const LR: RegisterId = RegisterId(14);
const PC: RegisterId = RegisterId(15);
const PSP: RegisterId = RegisterId(18);
/// The processor halts within some cycles or not at all.
const HALT_TIMEOUT: Duration = Duration::from_millis(100);
/// Number of stack words to read. At 1 MHz, the probe takes some 10 ms for them.
const STACK_WORDS: usize = 512;

pub(super) fn read_crash(core: &mut Core<'_>, image: &Image) -> Result<Option<CrashReport>, ProbeError> {
    let Some(exception) = active_handler(core)? else { return Ok(None) };
    let status = FaultStatus::read(|address| core.read_word_32(address))
        .map_err(ProbeError::line_error("reading the fault registers"))?;
    core.halt(HALT_TIMEOUT).map_err(ProbeError::line_error("halting the processor"))?;
    let [lr, sp, psp, pc] = read_registers(core)?;
    let symbols = image.symbols();
    let mut stack = ProbeStack { core, image };
    let frame = exception_frame(&mut stack, StoppedAt::Body, [lr, sp, psp]);
    // The handler may have changed r4 to r11, so the chain ends at a function whose frame they give.
    let chain = frame.map_or_else(CallChain::default, |frame| {
        let registers = FrameRegisters { sp: frame.end, lr: Some(frame.lr), saved: [None; 8] };
        call_chain(&mut stack, &symbols, frame.pc, registers)
    });
    let crash = CrashReport {
        exception,
        status,
        place: Some(symbols.locate(frame.map_or(pc, |frame| frame.pc) & !1)),
        callers: chain.callers,
        link: chain.link,
        address_owner: None,
        sp,
        at_us: None,
        watchdog_reset: false,
    };
    if active_handler(core)? == Some(exception) {
        return Ok(Some(crash));
    }
    Ok(Some(CrashReport { place: None, callers: Vec::new(), link: None, watchdog_reset: true, ..crash }))
}

fn active_handler(core: &mut Core<'_>) -> Result<Option<&'static str>, ProbeError> {
    let mut read = |address| core.read_word_32(address).map_err(ProbeError::line_error("reading the fault state"));
    if read(DHCSR)? & LOCKED_UP != 0 {
        return Ok(Some("lockup"));
    }
    // Exception 2, the NMI, is no trap of the firmware.
    Ok(Some(read(ICSR)? & 0x1FF).filter(|&number| number > 2).and_then(fault_handler))
}

fn read_registers(core: &mut Core<'_>) -> Result<[u32; 4], ProbeError> {
    let mut values = [0; 4];
    for (value, register) in values.iter_mut().zip([LR, SP, PSP, PC]) {
        *value = core.read_core_reg(register).map_err(ProbeError::line_error("reading a core register"))?;
    }
    Ok(values)
}

struct ProbeStack<'a, 'core> {
    core: &'a mut Core<'core>,
    image: &'a Image,
}

impl StackReader for ProbeStack<'_, '_> {
    fn stack(&mut self, address: u32) -> Vec<(u32, u32)> {
        let top = self.image.initial_stack().unwrap_or(u32::MAX);
        let mut words = vec![0; STACK_WORDS.min(top.saturating_sub(address) as usize / 4)];
        match self.core.read_32(u64::from(address), &mut words) {
            Ok(()) => (address..).step_by(4).zip(words).collect(),
            Err(_) => Vec::new(),
        }
    }

    fn code(&self, address: u32) -> Option<u16> {
        self.image.half_word(address)
    }
}
