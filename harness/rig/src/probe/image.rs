//! Reads the flash content of an ELF.

use super::error::ProbeError;
use crate::symbols::{CodeLocation, Symbols};
use object::elf::{EM_ARM, FileHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSymbol};

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Segment {
    /// Load address in flash. The firmware copies initialised data from there to RAM.
    pub address: u32,
    pub bytes: Vec<u8>,
}

#[derive(Debug, Clone)]
pub struct Image {
    elf: Vec<u8>,
    segments: Vec<Segment>,
    rtt_address: Option<u64>,
}

impl Image {
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
                segments.push(Segment { address: program.p_paddr(endian), bytes: bytes.to_vec() });
            }
        }
        if segments.is_empty() {
            return Err(refuse("it has no segment to load"));
        }
        let file = object::File::parse(elf).map_err(invalid)?;
        let rtt = file.symbols().find(|symbol| symbol.name() == Ok("_SEGGER_RTT") && symbol.is_definition());
        Ok(Self { rtt_address: rtt.map(|symbol| symbol.address()), segments, elf: elf.to_vec() })
    }

    pub fn segments(&self) -> &[Segment] {
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
