//! Describes a planned fault of the line or the sensor.

use std::time::Duration;

#[derive(Debug, Clone, Copy, PartialEq, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum WireFaultKind {
    Drop,
    /// Flips one bit, possibly of the delimiter.
    Flip,
    Duplicate,
    Delay(Duration),
    /// Loses the second half of the message, with the delimiter.
    Truncate,
    /// Sends four invalid frames, 64 bytes, before the message.
    Babble,
    /// Loses all messages in the window.
    Disconnect,
    /// Keeps Wd and Wq of the last sample before the window.
    Freeze,
    /// Multiplies Wd and Wq.
    Scale(f32),
}

impl WireFaultKind {
    pub(super) const COUNT: usize = 9;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub(super) const fn affects_sensor(self) -> bool {
        matches!(self, Self::Freeze | Self::Scale(_))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    ToController,
    FromController,
    /// Samples to the controller and commands from it, counted separately.
    Both,
}

/// Instants count from the start of the trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireFault {
    pub kind: WireFaultKind,
    pub from: Duration,
    /// Exclusive end; `None` for the end of the trial.
    pub until: Option<Duration>,
    pub direction: Direction,
    /// Affects every n-th message per direction in the window; 0 affects none.
    pub every: u32,
    pub seed: u64,
}

impl WireFault {
    pub(super) fn is_active_at(&self, now: Duration) -> bool {
        self.from <= now && self.until.is_none_or(|until| now < until)
    }
}
