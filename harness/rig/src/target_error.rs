//! Defines the errors of firmware on an emulated board or on a board with a debug probe.

use crate::crash_report::CrashReport;
use crate::symbols::CodeLocation;
use std::fmt;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TargetError {
    #[error("{0}")]
    Trap(Box<CrashReport>),
    #[error("the processor locked up (a fault within a fault handler) at {0}")]
    Lockup(CodeLocation),
    #[error("the target reset itself ({cause}) {at_us} µs after power-on; it was at {place}")]
    Reset { cause: String, at_us: u64, place: CodeLocation },
    #[error("the emulated STM32F427 does not support this access by the firmware: {0}")]
    Unsupported(UnsupportedAccess),
    #[error("the firmware did not answer within {waited_us} µs after the message arrived; the processor is at {place}")]
    Silent { waited_us: u64, place: CodeLocation },
    #[error(
        "the firmware did not answer the handshake on USART2 (PA2, PA3) within {waited_ms} ms after power-on; \
         it uses {}, and the processor is at {place}",
        if instances.is_empty() { "no peripheral".to_owned() } else { instances.join(", ") }
    )]
    NoHandshake { waited_ms: u64, instances: Vec<&'static str>, place: CodeLocation },
    #[error("the emulator failed: {0}")]
    Emulator(String),
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnsupportedAccess {
    /// Peripheral and register if they have names, and the kind of access.
    pub access: String,
    pub address: Option<u32>,
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
