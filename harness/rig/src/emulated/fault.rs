//! What can go wrong on an emulated board, in words for the one who wrote its firmware.

use crate::symbols::Place;
use std::fmt;

/// Why the firmware on an emulated board, or on one behind a debug probe, cannot go on, or may not be believed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TargetFault {
    /// The processor entered a fault handler, or the program panicked.
    #[error("{0}")]
    Trap(Box<Trap>),
    /// A fault within a fault handler.
    #[error("the processor locked up at {0}")]
    Lockup(Place),
    /// The firmware or its watchdog reset the processor.
    #[error("the target reset itself ({cause}) {at_us} us after power-on; it was at {place}")]
    Reset {
        /// What did it.
        cause: String,
        /// When.
        at_us: u64,
        /// Where the processor was when that was noticed.
        place: Place,
    },
    /// The firmware reached for something that the emulator has no model of, so that whatever follows proves nothing.
    #[error("the emulated STM32F427 cannot vouch for what the firmware does: {0}")]
    Unsupported(Gap),
    /// No answer to a message that asks for one.
    #[error("no answer {waited_us} us after the message had arrived; the processor is at {place}")]
    Silent {
        /// How long was waited, on the target's clock.
        waited_us: u64,
        /// Where the processor is.
        place: Place,
    },
    /// The firmware never answered to a handshake.
    #[error(
        "the firmware did not introduce itself on USART2 (PA2, PA3) within {waited_ms} ms after power-on; it uses {}, and the processor is at {place}",
        if instances.is_empty() { "nothing".to_owned() } else { instances.join(", ") }
    )]
    NoHandshake {
        /// How long was waited, on the target's clock.
        waited_ms: u64,
        /// Which peripherals the firmware has touched.
        instances: Vec<&'static str>,
        /// Where the processor is.
        place: Place,
    },
    /// The firmware's bytes are not as long as they should be.
    #[error("the firmware sends at {seen} baud instead of {expected}")]
    Baud {
        /// What the firmware should use.
        expected: u32,
        /// What it does use.
        seen: u32,
    },
    /// The processor of a board trapped; what its debug probe read of that.
    #[error("{0}")]
    OnBoard(String),
    /// The emulator itself failed.
    #[error("the emulator failed: {0}")]
    Emulator(String),
}

/// The state in which a fault handler was entered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trap {
    /// `HardFault`, `BusFault`, …, or `panic`.
    pub exception: &'static str,
    /// Where: the instruction that trapped, or the innermost call known where there is none.
    pub place: Option<Place>,
    /// The calls that led there, innermost first, as far as the stack still tells.
    pub calls: Vec<Place>,
    /// Address of the data access that failed.
    pub address: Option<u32>,
    /// What answers at that address on the part.
    pub instance: Option<&'static str>,
    /// Configurable fault status register.
    pub cfsr: u32,
    /// Hard fault status register.
    pub hfsr: u32,
    /// Link register where the fault struck.
    pub lr: Option<u32>,
    /// Stack pointer.
    pub sp: u32,
    /// Time since power-on.
    pub at_us: u64,
}

/// Bits of CFSR in words. ARMv7-M Architecture Reference Manual, B3.2.15.
const CAUSES: [(u32, &str); 16] = [
    (0, "instruction access violation"),
    (1, "data access violation"),
    (3, "access violation while unstacking"),
    (4, "access violation while stacking"),
    (5, "access violation while stacking floats"),
    (8, "instruction bus error"),
    (9, "data bus error"),
    (10, "imprecise data bus error"),
    (11, "bus error while unstacking"),
    (12, "bus error while stacking"),
    (13, "bus error while stacking floats"),
    (16, "undefined instruction"),
    (17, "invalid state"),
    (18, "invalid return address"),
    (19, "no such coprocessor"),
    (24, "unaligned access"),
];

impl Trap {
    /// What the fault status register says.
    pub fn causes(&self) -> Vec<&'static str> {
        let division = (25, "division by zero");
        CAUSES
            .into_iter()
            .chain([division])
            .filter(|(bit, _)| self.cfsr & 1 << bit != 0)
            .map(|(_, cause)| cause)
            .collect()
    }

    /// True where the stack pointer has left the memory that it had.
    pub fn is_stacking_failure(&self) -> bool {
        self.cfsr & (1 << 12 | 1 << 4) != 0
    }
}

impl fmt::Display for Trap {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "the firmware trapped: {}", self.exception)?;
        let causes = self.causes();
        if !causes.is_empty() {
            write!(formatter, ", {}", causes.join(", "))?;
        }
        if let Some(place) = &self.place {
            write!(formatter, ", at {place}")?;
        }
        if let Some(address) = self.address {
            write!(formatter, ", address {address:#010x}")?;
            match self.instance {
                Some(instance) => write!(formatter, " ({instance})")?,
                None => write!(formatter, " (nothing answers there)")?,
            }
        }
        if self.is_stacking_failure() {
            write!(formatter, ", stack pointer {:#010x}: the stack overflowed", self.sp)?;
        }
        for (index, call) in self.calls.iter().enumerate() {
            write!(formatter, "{}{call}", if index == 0 { "; called from " } else { ", from " })?;
        }
        write!(formatter, "; cfsr {:#010x}, hfsr {:#010x}, {} us after power-on", self.cfsr, self.hfsr, self.at_us)
    }
}

/// An access that the emulator answered without knowing what the part would do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gap {
    /// What was reached, as instance and register where it has a name.
    pub what: String,
    /// Its address, where it has one.
    pub address: Option<u32>,
    /// Who reached for it.
    pub place: Option<Place>,
}

impl fmt::Display for Gap {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.what)?;
        if let Some(address) = self.address {
            write!(formatter, ", address {address:#010x}")?;
        }
        match &self.place {
            Some(place) => write!(formatter, ", reached from {place}"),
            None => Ok(()),
        }
    }
}
