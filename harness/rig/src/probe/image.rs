//! Reads the flash content of an ELF, and a crash of its firmware through the debug probe.

use super::error::ProbeError;
use crate::crash_report::{
    CallChain, CrashReport, FaultStatus, ICSR, StackReader, StoppedAt, call_chain, exception_frame, fault_handler,
};
use crate::symbols::{CodeLocation, FrameRegisters, Symbols};
use object::elf::{EM_ARM, FileHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSymbol};
use probe_rs::{Core, MemoryInterface, RegisterId};
use std::time::Duration;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlashSegment {
    /// Load address in flash. The firmware copies initialised data from there to RAM.
    pub address: u32,
    pub bytes: Vec<u8>,
}

#[derive(Debug, Clone)]
pub struct FlashImage {
    elf: Vec<u8>,
    segments: Vec<FlashSegment>,
    rtt_address: Option<u64>,
}

impl FlashImage {
    pub fn parse(elf: &[u8]) -> Result<Self, ProbeError> {
        let refuse = |problem: &str| ProbeError::Image { problem: problem.to_owned() };
        let invalid = |error: object::Error| refuse(&error.to_string());
        let header = FileHeader32::<Endianness>::parse(elf).map_err(invalid)?;
        let endian = header.endian().map_err(invalid)?;
        if header.e_machine(endian) != EM_ARM || endian != Endianness::Little {
            return Err(refuse("it is not for a little-endian ARM"));
        }
        let mut segments = Vec::new();
        for program in header.program_headers(endian, elf).map_err(invalid)? {
            let bytes = program.data(endian, elf).map_err(|()| refuse("a segment lies outside the file"))?;
            if program.p_type(endian) == PT_LOAD && !bytes.is_empty() {
                segments.push(FlashSegment { address: program.p_paddr(endian), bytes: bytes.to_vec() });
            }
        }
        if segments.is_empty() {
            return Err(refuse("it has no segment to load"));
        }
        let file = object::File::parse(elf).map_err(invalid)?;
        let rtt = file.symbols().find(|symbol| symbol.name() == Ok("_SEGGER_RTT") && symbol.is_definition());
        Ok(Self { rtt_address: rtt.map(|symbol| symbol.address()), segments, elf: elf.to_vec() })
    }

    pub fn segments(&self) -> &[FlashSegment] {
        &self.segments
    }

    pub fn flash_bytes(&self) -> usize {
        self.segments.iter().map(|segment| segment.bytes.len()).sum()
    }

    pub fn rtt(&self) -> Option<u64> {
        self.rtt_address
    }

    pub fn locate(&self, address: u32) -> CodeLocation {
        self.symbols().locate(address)
    }

    pub(super) fn symbols(&self) -> Symbols {
        Symbols::read(&self.elf)
    }

    /// Returns the first word of the vector table, which is at the lowest address of the image.
    pub(super) fn initial_stack(&self) -> Option<u32> {
        let first = self.segments.iter().min_by_key(|segment| segment.address)?;
        first.bytes.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
    }

    pub(super) fn half_word(&self, address: u32) -> Option<u16> {
        self.segments.iter().find_map(|segment| {
            let from = address.checked_sub(segment.address)? as usize;
            Some(u16::from_le_bytes(*segment.bytes.get(from..)?.first_chunk()?))
        })
    }
}

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

/// The processor runs while its fault handler takes the drive to 0 V. Then the bench halts it to read
/// its core registers and stack. The chip's watchdog may reset the processor meanwhile.
pub(super) fn read_crash(core: &mut Core<'_>, image: &FlashImage) -> Result<Option<CrashReport>, ProbeError> {
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
    image: &'a FlashImage,
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
