//! Describes a changed instruction or constant.

use platebench_rig::symbols::SourceLine;
use std::fmt;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Operator {
    /// Addition and subtraction, multiplication and division, sign.
    Arithmetic,
    /// A condition and its negation.
    Condition,
    /// `<` and `≤`, `>` and `≥`.
    Boundary,
    /// An immediate value, or a value in the literal pool.
    Constant,
    RemovedCall,
    RemovedStore,
    /// `SSAT`, `USAT`, and moves on the condition of a comparison of floats, as `clamp` compiles to.
    RemovedSaturation,
}

impl Operator {
    pub const ALL: [Self; 7] = [
        Self::Arithmetic,
        Self::Condition,
        Self::Boundary,
        Self::Constant,
        Self::RemovedCall,
        Self::RemovedStore,
        Self::RemovedSaturation,
    ];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Arithmetic => "arithmetic",
            Self::Condition => "negated condition",
            Self::Boundary => "comparison off by one",
            Self::Constant => "constant",
            Self::RemovedCall => "removed call",
            Self::RemovedStore => "removed store",
            Self::RemovedSaturation => "removed saturation",
        }
    }
}

impl fmt::Display for Operator {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// New bytes of an instruction or of a constant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Change {
    pub(crate) operator: Operator,
    pub(crate) address: u32,
    pub(crate) bytes: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mutant {
    pub operator: Operator,
    /// The instruction whose effect changes.
    pub instruction: u32,
    /// Where `bytes` replace `original`: the instruction, or its constant.
    pub address: u32,
    pub original: Vec<u8>,
    pub bytes: Vec<u8>,
    /// The instruction ran while the firmware answered a sample.
    pub in_control_step: bool,
    pub function: String,
    pub line: Option<SourceLine>,
    /// Disassembly, or the value of a constant.
    pub before: String,
    pub after: String,
}
