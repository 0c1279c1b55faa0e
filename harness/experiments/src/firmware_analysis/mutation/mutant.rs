//! Describes a changed instruction or constant.

use platebench_rig::symbols::SourceLine;

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, strum::VariantArray, strum::Display, strum::IntoStaticStr,
)]
#[strum(const_into_str, serialize_all = "snake_case")]
pub enum Operator {
    /// Exchanges addition and subtraction, or multiplication and division, or removes a change of
    /// sign.
    Arithmetic,
    #[strum(serialize = "negated condition")]
    Condition,
    /// Exchanges `<` and `≤`, or `>` and `≥`.
    #[strum(serialize = "comparison off by one")]
    Boundary,
    /// Changes an immediate value or a value in the literal pool.
    Constant,
    #[strum(serialize = "removed call")]
    RemovedCall,
    #[strum(serialize = "removed store")]
    RemovedStore,
    /// Removes `SSAT`, `USAT` and the conditional moves to which `clamp` of floats compiles.
    #[strum(serialize = "removed saturation")]
    RemovedSaturation,
}

impl Operator {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Change {
    pub(crate) operator: Operator,
    pub(crate) address: u32,
    pub(crate) bytes: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mutant {
    pub operator: Operator,
    /// Address of the instruction whose effect changes.
    pub instruction: u32,
    /// Address of `original`, which is the instruction or its constant.
    pub address: u32,
    pub original: Vec<u8>,
    pub bytes: Vec<u8>,
    /// True if the instruction ran while the firmware answered a sample.
    pub in_control_step: bool,
    pub function: String,
    pub line: Option<SourceLine>,
    /// Disassembly of the instruction, or value of the constant.
    pub before: String,
    pub after: String,
}
