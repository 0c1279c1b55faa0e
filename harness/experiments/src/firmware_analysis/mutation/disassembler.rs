//! Prints machine code as assembly.

use crate::firmware_analysis::error::AnalysisError;
use capstone::arch::arm::{ArchExtraMode, ArchMode};
use capstone::arch::{BuildsCapstone, BuildsCapstoneExtraMode};
use capstone::{Capstone, Error};

pub struct Disassembler(Capstone);

impl Disassembler {
    pub fn new() -> Result<Self, AnalysisError> {
        let built = Capstone::new().arm().mode(ArchMode::Thumb).extra_mode([ArchExtraMode::MClass].into_iter()).build();
        built.map(Self).map_err(|error: Error| AnalysisError::Disassembler(error.to_string()))
    }

    /// Returns assembly such as `vadd.f32 s0, s1, s2`. `None` if `bytes` are no instruction.
    pub fn text(&self, address: u32, bytes: &[u8]) -> Option<String> {
        let instructions = self.0.disasm_count(bytes, u64::from(address), 1).ok()?;
        let instruction = instructions.iter().next().filter(|one| one.bytes().len() == bytes.len())?;
        Some(format!("{} {}", instruction.mnemonic()?, instruction.op_str().unwrap_or_default()).trim_end().to_owned())
    }
}
