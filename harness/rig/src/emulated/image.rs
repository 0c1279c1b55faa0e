//! Reads and checks a firmware image for the emulated board, and defines the options and the errors
//! of its start.

use crate::debug_port::DebuggerError;
use crate::link::TargetError;
use object::LittleEndian;
use object::read::elf::{ElfFile32, FileHeader as _, ProgramHeader as _};
use platebench_model::trace::{MAX_IMAGE_BYTES, read_regular_file};
use std::any::Any;
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{io, panic};

pub(super) const FLASH_START: u64 = 0x0800_0000;
const FLASH: std::ops::Range<u64> = FLASH_START..0x0820_0000;
const SRAM: std::ops::RangeInclusive<u32> = 0x2000_0000..=0x2003_0000;
const CCM: std::ops::RangeInclusive<u32> = 0x1000_0000..=0x1001_0000;
const ARM: u16 = 40;
const RELOCATABLE: u16 = 1;
const EXECUTABLE: u16 = 2;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    #[error("not an ELF file")]
    NotElf,
    #[error("a {0} ELF, expected 32 bits, little endian")]
    Class(&'static str),
    #[error("built for {}, expected ARM (thumbv7em-none-eabihf, thumbv7em-none-eabi or arm-none-eabi)", machine(*.0))]
    Machine(u16),
    #[error("not linked to an executable (ELF type {0})")]
    NotExecutable(u16),
    #[error("made by objcopy from a hex or binary file, without segments and symbols; give the ELF of the linker")]
    Converted,
    #[error("damaged: {0}")]
    Damaged(String),
    #[error(
        "{length} bytes are linked to {address:#010x}, expected flash from 0x08000000 to 0x08200000, \
         where the processor starts"
    )]
    Misplaced { address: u64, length: u64 },
    #[error("no vector table at 0x08000000, where the processor starts")]
    NoVectors,
    #[error("the vector table's stack pointer {0:#010x} is not an address in SRAM or CCM, or not a multiple of 4")]
    Stack(u32),
    #[error("the vector table's reset vector {0:#010x} is not Thumb code of this image")]
    Reset(u32),
}

fn machine(number: u16) -> String {
    let name = match number {
        3 => "x86",
        8 => "MIPS",
        62 => "x86-64",
        83 => "AVR",
        94 => "Xtensa",
        183 => "AArch64",
        243 => "RISC-V",
        _ => return format!("processor number {number}"),
    };
    name.to_owned()
}

#[derive(Debug, Clone)]
pub(super) struct Segment {
    pub(super) address: u64,
    pub(super) bytes: Arc<[u8]>,
}

#[derive(Debug, Clone)]
pub(super) struct Image {
    pub(super) elf: Arc<[u8]>,
    pub(super) segments: Vec<Segment>,
    pub(super) initial_stack: u32,
    /// True if the calls of the image pass floats in registers of the FPU, as its header says.
    pub(super) is_hard_float: bool,
}

impl Image {
    pub(super) fn new(elf: Arc<[u8]>) -> Result<Self, ImageError> {
        check_header(&elf)?;
        let damaged = |problem: &dyn std::fmt::Display| ImageError::Damaged(problem.to_string());
        let file = ElfFile32::<LittleEndian>::parse(&*elf).map_err(|error| damaged(&error))?;
        let mut segments = Vec::new();
        for header in file.elf_program_headers() {
            let data = header
                .data(LittleEndian, &*elf)
                .map_err(|()| damaged(&"a segment reaches past the end of the file"))?;
            if header.p_type(LittleEndian) != object::elf::PT_LOAD || data.is_empty() {
                continue;
            }
            let (address, length) = (u64::from(header.p_paddr(LittleEndian)), data.len() as u64);
            if !FLASH.contains(&address) || address + length > FLASH.end {
                return Err(ImageError::Misplaced { address, length });
            }
            segments.push(Segment { address, bytes: data.into() });
        }
        let word = |at: u64| {
            segments.iter().find_map(|segment| {
                let from = usize::try_from(at.checked_sub(segment.address)?).ok()?;
                Some(u32::from_le_bytes(*segment.bytes.get(from..)?.first_chunk()?))
            })
        };
        let (Some(initial_stack), Some(reset)) = (word(FLASH.start), word(FLASH.start + 4)) else {
            return Err(ImageError::NoVectors);
        };
        let in_memory = SRAM.contains(&initial_stack) || CCM.contains(&initial_stack);
        if !in_memory || !initial_stack.is_multiple_of(4) {
            return Err(ImageError::Stack(initial_stack));
        }
        if reset % 2 == 0 || word(u64::from(reset - 1) & !3).is_none() {
            return Err(ImageError::Reset(reset));
        }
        let is_hard_float = file.elf_header().e_flags(LittleEndian) & object::elf::EF_ARM_ABI_FLOAT_HARD != 0;
        drop(file);
        Ok(Self { elf, segments, initial_stack, is_hard_float })
    }
}

fn check_header(elf: &[u8]) -> Result<(), ImageError> {
    if !elf.starts_with(b"\x7fELF") {
        return Err(ImageError::NotElf);
    }
    let cut = || ImageError::Damaged("the file ends within its header".to_owned());
    let half = |at: usize| elf.get(at..).and_then(|rest| rest.first_chunk()).map(|two| u16::from_le_bytes(*two));
    let &[class, data] = elf.get(4..).and_then(|rest| rest.first_chunk::<2>()).ok_or_else(cut)?;
    let (kind, processor) = half(16).zip(half(18)).ok_or_else(cut)?;
    // A compiler writes the version of the ABI; a conversion from another format does not.
    let eabi_flags = elf.get(36..).and_then(|rest| rest.first_chunk()).map(|four| u32::from_le_bytes(*four));
    match (class, data) {
        (1 | 2, 1) if processor != ARM => Err(ImageError::Machine(processor)),
        (1, 1) if kind == RELOCATABLE && eabi_flags == Some(0) => Err(ImageError::Converted),
        (1, 1) if kind != EXECUTABLE => Err(ImageError::NotExecutable(kind)),
        (1, 1) => Ok(()),
        (2, _) => Err(ImageError::Class("64-bit")),
        (_, 2) => Err(ImageError::Class("big-endian")),
        _ => Err(ImageError::Damaged("the header gives no valid word size and byte order".to_owned())),
    }
}

pub(crate) fn read_elf(elf: &Path) -> io::Result<Vec<u8>> {
    read_regular_file(elf, MAX_IMAGE_BYTES)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EmulatedOptions {
    /// Frequency of the crystal on PH0 and PH1; 0 for no crystal.
    pub crystal_hz: u64,
    /// If false, the firmware handles traps, panics and resets, as on a board.
    pub stop_at_traps: bool,
}

impl Default for EmulatedOptions {
    fn default() -> Self {
        Self { crystal_hz: 8_000_000, stop_at_traps: true }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum EmulatedError {
    #[error("{}: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error("not a firmware for the emulated board: {0}")]
    Image(#[from] ImageError),
    #[error(transparent)]
    Debugger(#[from] DebuggerError),
    #[error(transparent)]
    Target(#[from] TargetError),
}

pub(super) fn read_image(elf: &Path) -> Result<Vec<u8>, EmulatedError> {
    read_elf(elf).map_err(|error| EmulatedError::Read { path: elf.to_owned(), error })
}

pub(super) fn catch_emulator_panic<T>(run: impl FnOnce() -> Result<T, TargetError>) -> Result<T, TargetError> {
    let panicked = |cause: Box<dyn Any + Send>| {
        let text = cause.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("no message");
        TargetError::Emulator(format!("it panicked: {text}"))
    };
    panic::catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|cause| Err(panicked(cause)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_a_device_as_firmware() {
        let error = read_elf(Path::new("/dev/zero")).unwrap_err().to_string();
        assert_eq!(error, "it is a pipe or a device, expected a file");
        assert_eq!(read_elf(Path::new("/")).unwrap_err().to_string(), "it is a folder, expected a file");
    }

    #[test]
    fn reports_a_panic_of_the_emulator_as_an_error() {
        let result =
            catch_emulator_panic(
                || if std::hint::black_box(false) { Ok(()) } else { panic!("checked at construction") },
            );
        assert_eq!(result, Err(TargetError::Emulator("it panicked: checked at construction".to_owned())));
    }
}
