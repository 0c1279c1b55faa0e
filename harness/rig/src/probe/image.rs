//! What an ELF puts where.

use super::error::ProbeError;
use crate::symbols::{Place, Symbols};
use object::elf::{EM_ARM, FileHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSymbol};

/// Bytes for one place in flash.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Segment {
    /// Where they are stored, which for initialised data is not where they are used.
    pub address: u32,
    /// What is stored.
    pub bytes: Vec<u8>,
}

/// A firmware image, checked: for ARM, with something to flash.
#[derive(Debug, Clone)]
pub struct Image {
    elf: Vec<u8>,
    segments: Vec<Segment>,
    rtt: Option<u64>,
}

impl Image {
    /// Reads an ELF.
    ///
    /// # Errors
    /// [`ProbeError::Image`] where it is none for a 32-bit ARM or holds nothing to flash.
    pub fn parse(elf: &[u8]) -> Result<Self, ProbeError> {
        let refuse = |problem: &str| ProbeError::Image { problem: problem.to_owned() };
        let unread = |error: object::Error| refuse(&error.to_string());
        let header = FileHeader32::<Endianness>::parse(elf).map_err(unread)?;
        let endian = header.endian().map_err(unread)?;
        if header.e_machine(endian) != EM_ARM || endian != Endianness::Little {
            return Err(refuse("it is not for a little-endian ARM"));
        }
        let mut segments = Vec::new();
        for program in header.program_headers(endian, elf).map_err(unread)? {
            let bytes = program.data(endian, elf).map_err(|()| refuse("a segment lies outside the file"))?;
            if program.p_type(endian) == PT_LOAD && !bytes.is_empty() {
                segments.push(Segment { address: program.p_paddr(endian), bytes: bytes.to_vec() });
            }
        }
        if segments.is_empty() {
            return Err(refuse("it has no segment to load"));
        }
        let file = object::File::parse(elf).map_err(unread)?;
        let rtt = file.symbols().find(|symbol| symbol.name() == Ok("_SEGGER_RTT") && symbol.is_definition());
        Ok(Self { rtt: rtt.map(|symbol| symbol.address()), segments, elf: elf.to_vec() })
    }

    /// What is to be in flash.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// How many bytes that is.
    pub fn flash_bytes(&self) -> usize {
        self.segments.iter().map(|segment| segment.bytes.len()).sum()
    }

    /// Where the RTT control block is, where the firmware has one.
    pub fn rtt(&self) -> Option<u64> {
        self.rtt
    }

    /// Function and source line of an address, as far as the image tells.
    pub fn place(&self, address: u32) -> Place {
        self.symbols().place(address)
    }

    pub(super) fn symbols(&self) -> Symbols {
        Symbols::read(&self.elf)
    }
}
