//! Defines planned faults of the chip, which only the emulated rig can apply (`docs/scenarios.md`).

use platebench_plate::Time;

/// `ClockDrift` is the frequency error in parts per million, positive if the clocks are fast. If
/// the `bit` of a `BitFlip` is `None`, the trial's seed selects the bit.
#[derive(Debug, Clone, PartialEq)]
pub enum ChipFaultKind {
    BitFlip { target: BitFlipTarget, bit: Option<u32> },
    Reset,
    PowerCut,
    ClockDrift(f64),
    Hang,
    Stuck { address: u32, value: u32 },
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BitFlipTarget {
    Ram {
        start: u32,
        length: u32,
    },
    /// Name of an ELF symbol, mangled or demangled.
    Variable(String),
    /// Register number: 0 to 12 are r0 to r12, 13 is sp, 14 is lr, 15 is pc.
    Register(usize),
}

impl BitFlipTarget {
    pub const EXPECTED: &'static str = "\"ram:0x20000000+4096\", \"variable:NAME\" or \"register:r4\"";

    pub fn parse(text: &str) -> Option<Self> {
        let (kind, name) = text.split_once(':')?;
        match kind {
            "ram" => {
                let (start, length) = name.split_once('+')?;
                let (start, length) = (parse_address(start)?, parse_address(length)?);
                (length > 0 && start.checked_add(length).is_some()).then_some(Self::Ram { start, length })
            }
            "variable" if !name.is_empty() => Some(Self::Variable(name.to_owned())),
            "register" => match name {
                "sp" => Some(Self::Register(13)),
                "lr" => Some(Self::Register(14)),
                "pc" => Some(Self::Register(15)),
                _ => {
                    let number = name.strip_prefix('r')?.parse().ok()?;
                    (number <= 12).then_some(Self::Register(number))
                }
            },
            _ => None,
        }
    }
}

pub(crate) fn parse_address(text: &str) -> Option<u32> {
    text.strip_prefix("0x").map_or_else(|| text.parse().ok(), |digits| u32::from_str_radix(digits, 16).ok())
}

#[derive(Debug, Clone, PartialEq)]
pub struct ChipFault {
    pub kind: ChipFaultKind,
    /// Instant of the fault. If it is `None`, the trial's seed selects the instant.
    pub at: Option<Time>,
}

impl ChipFault {
    pub const fn is_random(&self) -> bool {
        self.at.is_none() || matches!(self.kind, ChipFaultKind::BitFlip { bit: None, .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case("ram:0x20000000+4096", Some(BitFlipTarget::Ram { start: 0x2000_0000, length: 4096 }))]
    #[case("variable:integral", Some(BitFlipTarget::Variable("integral".to_owned())))]
    #[case("register:r4", Some(BitFlipTarget::Register(4)))]
    #[case("register:pc", Some(BitFlipTarget::Register(15)))]
    #[case("register:r13", None)]
    #[case("ram:0x20000000+0", None)]
    #[case("ram:0xffffffff+2", None)]
    #[case("variable:", None)]
    #[case("flash:0x08000000+4", None)]
    fn reads_the_target_of_a_bit_flip(#[case] text: &str, #[case] target: Option<BitFlipTarget>) {
        assert_eq!(BitFlipTarget::parse(text), target);
    }
}
