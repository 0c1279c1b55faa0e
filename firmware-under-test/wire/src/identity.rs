//! Defines the identity message of the target and the numbers and names of the control laws.

use crate::field::{Field, MessageError, Reader, Writer, layout};

macro_rules! laws {
    ($($(#[$doc:meta])* $law:ident = $number:literal, $name:literal;)*) => {
        /// The numbers are part of the protocol. Scenario files and the option `--law` use the names.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[repr(u8)]
        pub enum LawId {
            $($(#[$doc])* $law = $number,)*
        }

        impl LawId {
            pub const ALL: [Self; [$($number),*].len()] = [$(Self::$law),*];

            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$law => $name,)*
                }
            }
        }
    };
}

// `law = number, name`.
laws! {
    OpenLoop = 0, "open-loop";
    /// Two PI loops. Their gains are those of equation 24, matched to the zero-order hold and to
    /// the plate's present damping.
    DqPi = 1, "dq-pi";
    /// Two PI loops with the gains of equation 24 as printed and a forward-Euler integral.
    DqPiEuler = 2, "dq-pi-euler";
    VoltageOnly = 3, "voltage-only";
    /// At constant drive, the frequency adjusts the amplitude.
    FrequencyOnly = 4, "frequency-only";
    BangBang = 5, "bang-bang";
    Pll = 6, "pll";
    /// Identifies the plate in one period, steers to the setpoint in the next, then holds it by PI.
    Deadbeat = 7, "deadbeat";
    /// `DqPi` with the constant gains of the untouched plate.
    DqPiFixed = 8, "dq-pi-fixed";
}

impl LawId {
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|law| law.name() == name)
    }
}

impl Field for LawId {
    fn write(&self, writer: &mut Writer) {
        writer.write(&(*self as u8));
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let number: u8 = reader.read()?;
        Self::ALL.into_iter().find(|&law| law as u8 == number).ok_or(MessageError::Field)
    }
}

/// Bits of [`Identity::capabilities`]. The target supports `paced_by_target`, `compute_us`,
/// `loop_delay_us` and `drives_own_plate`, in this order.
pub mod capabilities {
    pub const TARGET_PACED: u8 = 1;
    pub const COMPUTE_TIME: u8 = 2;
    pub const LOOP_DELAY: u8 = 4;
    pub const OWN_PLATE: u8 = 8;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Major, minor, patch.
    pub version: [u8; 3],
    /// Bits of [`capabilities`]; readers ignore unknown bits.
    pub capabilities: u8,
    /// Bit n is set if the target has the law with number n.
    pub laws: u32,
    /// First eight bytes of the SHA-256 of the firmware's sources; zero if unknown.
    pub build: [u8; 8],
    /// `DBGMCU_IDCODE` on an STM32; zero for a program on a computer.
    pub chip: u32,
    /// Unique number of the chip. On a computer it is zero unless the option `--unique` sets it.
    pub unique: [u8; 12],
    /// ASCII, padded with zeros.
    pub name: [u8; 16],
}
layout!(Identity { version, capabilities, laws, build, chip, unique, name });

impl Identity {
    pub fn has_law(&self, law: LawId) -> bool {
        self.laws & 1 << law as u8 != 0
    }

    pub fn has_capability(&self, capability: u8) -> bool {
        self.capabilities & capability != 0
    }
}
