//! Describes a planned fault of the chip, which only the emulated board can apply.

use std::time::Duration;

#[derive(Debug, Clone, PartialEq)]
pub enum ChipFaultKind {
    /// Flips one bit of `length` bytes at `start`: bit `draw` modulo the number of bits.
    FlipRam {
        start: u32,
        length: u32,
        draw: u64,
    },
    FlipVariable {
        name: String,
        draw: u64,
    },
    /// `number` is GDB's number of the register: 0 to 12 for r0 to r12, then sp, lr, pc.
    FlipRegister {
        number: usize,
        draw: u64,
    },
    Reset,
    PowerCut,
    ClockDrift {
        ppm: f64,
    },
    Hang,
    Stuck {
        address: u32,
        value: u32,
    },
}

impl ChipFaultKind {
    pub const fn name(&self) -> &'static str {
        match self {
            Self::FlipRam { .. } | Self::FlipVariable { .. } | Self::FlipRegister { .. } => "bit-flip",
            Self::Reset => "reset",
            Self::PowerCut => "power-cut",
            Self::ClockDrift { .. } => "clock-drift",
            Self::Hang => "hang",
            Self::Stuck { .. } => "stuck",
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct ChipFault {
    /// Time since the start of the trial.
    pub at: Duration,
    pub kind: ChipFaultKind,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct ChipFaultPlan {
    /// Sorted by time.
    pub faults: Vec<ChipFault>,
    /// The plate waits at most this long for an answer.
    pub answer_timeout: Duration,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ChipFaultError {
    #[error("only the emulated rig in lockstep can apply faults of the chip")]
    Unsupported,
    #[error("the firmware image has no variable `{0}` with a size; list them with `nm --size-sort --demangle`")]
    NoVariable(String),
    #[error("the fault needs {length} bytes at {start:#010x}, which are not RAM of the emulated STM32F427")]
    NoRam { start: u32, length: u32 },
}
