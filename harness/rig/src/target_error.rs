//! Defines the errors of the firmware on an emulated board or on one with a debug probe.

use crate::crash_report::CrashReport;
use crate::symbols::CodeLocation;
use std::fmt;

/// Why the firmware cannot go on, or why its answers are not valid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TargetError {
    /// The processor entered a fault handler, or the program panicked.
    #[error("{0}")]
    Trap(Box<CrashReport>),
    /// A fault within a fault handler.
    #[error("the processor locked up at {0}")]
    Lockup(CodeLocation),
    /// The firmware or its watchdog reset the processor.
    #[error("the target reset itself ({cause}) {at_us} µs after power-on; it was at {place}")]
    Reset {
        /// What reset it.
        cause: String,
        /// Time since power-on.
        at_us: u64,
        /// Where the processor was when the bench noticed.
        place: CodeLocation,
    },
    /// The firmware used something that the emulator has no model of.
    #[error("the emulated STM32F427 has no model of an access by the firmware: {0}")]
    Unsupported(UnsupportedAccess),
    /// No answer to a message that asks for one.
    #[error("no answer {waited_us} µs after the message arrived; the processor is at {place}")]
    Silent {
        /// Waiting time on the target's clock.
        waited_us: u64,
        /// Where the processor is.
        place: CodeLocation,
    },
    /// The firmware never answered the handshake.
    #[error(
        "the firmware did not answer the handshake on USART2 (PA2, PA3) within {waited_ms} ms after power-on; \
         it uses {}, and the processor is at {place}",
        if instances.is_empty() { "no peripheral".to_owned() } else { instances.join(", ") }
    )]
    NoHandshake {
        /// Waiting time on the target's clock.
        waited_ms: u64,
        /// The peripherals that the firmware has accessed.
        instances: Vec<&'static str>,
        /// Where the processor is.
        place: CodeLocation,
    },
    /// The firmware uses another baud rate than expected.
    #[error("the firmware sends at {measured} baud, expected {expected}")]
    BaudMismatch {
        /// The expected rate.
        expected: u32,
        /// The measured rate.
        measured: u32,
    },
    /// The emulator itself failed.
    #[error("the emulator failed: {0}")]
    Emulator(String),
}

/// An access that the emulator answered without a model of the hardware.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnsupportedAccess {
    /// Peripheral and register if they have names, and the kind of access.
    pub access: String,
    /// Its address, if it has one.
    pub address: Option<u32>,
    /// The accessing instruction, if known.
    pub place: Option<CodeLocation>,
}

impl fmt::Display for UnsupportedAccess {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.access)?;
        if let Some(address) = self.address {
            write!(formatter, ", address {address:#010x}")?;
        }
        self.place.as_ref().map_or(Ok(()), |place| write!(formatter, ", accessed from {place}"))
    }
}
