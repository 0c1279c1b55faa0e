//! Describes a planned fault of the line or the sensor.

use std::time::Duration;

/// The effect of a fault on a message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum WireFaultKind {
    /// The message is lost.
    Drop,
    /// One bit is flipped, possibly of the delimiter.
    Flip,
    /// The message arrives twice.
    Duplicate,
    /// The message arrives later by this time.
    Delay(Duration),
    /// The second half is lost, with the delimiter.
    Truncate,
    /// 64 bytes of noise precede the message: four invalid frames.
    Babble,
    /// The message is lost, like all others in the window.
    Disconnect,
    /// The sample keeps the components from before the window.
    Freeze,
    /// The sample's components are multiplied by this factor.
    Scale(f32),
}

impl WireFaultKind {
    pub(super) const COUNT: usize = 9;

    /// The name in scenario files and records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Drop => "drop",
            Self::Flip => "flip",
            Self::Duplicate => "duplicate",
            Self::Delay(_) => "delay",
            Self::Truncate => "truncate",
            Self::Babble => "babble",
            Self::Disconnect => "disconnect",
            Self::Freeze => "freeze",
            Self::Scale(_) => "scale",
        }
    }

    /// True for faults of the sensor, which act on samples before the line does.
    pub(super) const fn affects_sensor(self) -> bool {
        matches!(self, Self::Freeze | Self::Scale(_))
    }
}

/// The messages that a fault affects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Samples.
    ToController,
    /// Commands.
    FromController,
    /// Both, counted separately.
    Both,
}

/// A planned fault. Instants count from the start of the trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireFault {
    /// Its effect.
    pub kind: WireFaultKind,
    /// Start of its window.
    pub from: Duration,
    /// End of its window, exclusive; `None`: the end of the trial.
    pub until: Option<Duration>,
    /// The messages that it affects.
    pub direction: Direction,
    /// Affects the n-th, 2n-th, … message per direction in the window; 0 affects none.
    pub every: u32,
    /// Seed of its random bits and bytes.
    pub seed: u64,
}

impl WireFault {
    pub(super) fn is_active_at(&self, now: Duration) -> bool {
        self.from <= now && self.until.is_none_or(|until| now < until)
    }
}
