//! What goes wrong on the line to the controller, on purpose. What each fault does to a message: `docs/scenarios.md`; the middleware that does it lives
//! with the rigs.

use platebench_plate::Time;

/// What a fault does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// The message is lost.
    Drop,
    /// One of its bits is flipped.
    Flip,
    /// It comes twice.
    Duplicate,
    /// It comes so much later.
    Delay(Time),
    /// Its second half is lost, and the delimiter with it.
    Truncate,
    /// Noise stands before it, four frames' worth.
    Babble,
    /// Nothing passes.
    Disconnect,
    /// The sensor shows what it showed before the window.
    Freeze,
    /// The sensor shows so many times what there is.
    Scale(f64),
}

impl FaultKind {
    /// Every kind by its name in scenario files.
    pub const NAMES: [&'static str; 9] =
        ["drop", "flip", "duplicate", "delay", "truncate", "babble", "disconnect", "freeze", "scale"];

    /// True where it acts on the sensor instead of the line.
    pub const fn affects_sensor(self) -> bool {
        matches!(self, Self::Freeze | Self::Scale(_))
    }

    /// True where something about it is left to chance.
    pub const fn is_random(self) -> bool {
        matches!(self, Self::Flip | Self::Babble)
    }
}

/// Which way the messages go that a fault strikes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Direction {
    /// Samples.
    ToController,
    /// Commands.
    FromController,
    /// Samples and commands, each counted by themselves.
    #[default]
    Both,
}

impl Direction {
    /// Every direction.
    pub const ALL: [Self; 3] = [Self::ToController, Self::FromController, Self::Both];

    /// The direction's name in scenario files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ToController => "to-controller",
            Self::FromController => "from-controller",
            Self::Both => "both",
        }
    }
}

/// One fault with its window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// What it does.
    pub kind: FaultKind,
    /// Start of the window.
    pub from: Time,
    /// End of the window, no longer inside; `None` for a line that stays dead.
    pub until: Option<Time>,
    /// Which messages it strikes.
    pub direction: Direction,
    /// The n-th, 2n-th, … message of a direction in the window.
    pub every: u32,
    /// Of what is left to chance; the trial's own where not given.
    pub seed: Option<u64>,
    /// True where a controller that stopped because of it is configured anew after the window.
    pub reconfigure: bool,
}

impl Fault {
    /// True within the window.
    pub fn is_active_at(&self, time: Time) -> bool {
        self.from <= time && self.until.is_none_or(|until| time < until)
    }

    /// True where this fault is near enough to be the reason for a missing answer or a stop at `time`: within the window and for one period after it, in which a frame without
    /// a delimiter takes the next one with it and a controller that stopped unheard says so; after a delay, also while what was held up still comes in. A
    /// line that stays dead explains nothing: its controller is lost.
    pub fn can_explain(&self, time: Time, period: Time) -> bool {
        let held = match self.kind {
            FaultKind::Delay(delay) => delay,
            _ => Time::ZERO,
        };
        self.until.is_some_and(|until| self.from <= time && time < until + period + held)
    }

    /// True where this fault may be the reason for an answer that is missing at `time`: near enough, and of a kind that loses answers, or holds them up for a
    /// period. What only doubles, disturbs or delays a little, or falsifies what is sensed, is no reason to say nothing.
    pub fn can_explain_silence(&self, time: Time, period: Time) -> bool {
        let loses = match self.kind {
            FaultKind::Drop | FaultKind::Flip | FaultKind::Truncate | FaultKind::Disconnect => true,
            FaultKind::Delay(delay) => delay.times(if self.direction == Direction::Both { 2 } else { 1 }) >= period,
            FaultKind::Duplicate | FaultKind::Babble | FaultKind::Freeze | FaultKind::Scale(_) => false,
        };
        loses && self.can_explain(time, period)
    }

    /// True where it keeps every sample from the controller for so long that a patience of `patience` is over before the next one comes.
    pub fn exceeds_watchdog(&self, patience: Time, period: Time) -> bool {
        let silent = match self.kind {
            FaultKind::Delay(delay) => Some(delay),
            FaultKind::Drop | FaultKind::Disconnect => self.until.map(|until| until - self.from),
            _ => return false,
        };
        // Since the last sample that came.
        self.direction != Direction::FromController
            && self.every == 1
            && silent.is_none_or(|silent| silent + period >= patience)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silence_outlasts_a_patience_from_the_last_sample_on() {
        let ms = |ms: u64| Time::from_nanos(ms * 1_000_000);
        let until = |until| Some(ms(40) + until);
        let drop = Fault {
            kind: FaultKind::Drop,
            from: ms(40),
            until: until(ms(4)),
            direction: Direction::ToController,
            every: 1,
            seed: None,
            reconfigure: false,
        };
        // The last sample came at 39 ms, the next one comes at 44 ms.
        let outlasts = |fault: Fault| fault.exceeds_watchdog(ms(5), ms(1));
        assert!(outlasts(drop));
        assert!(!outlasts(Fault { until: until(ms(4) - Time::from_nanos(1)), ..drop }));
        assert!(outlasts(Fault { kind: FaultKind::Disconnect, until: None, direction: Direction::Both, ..drop }));
        assert!(outlasts(Fault { kind: FaultKind::Delay(ms(4)), ..drop }));
        assert!(!outlasts(Fault { kind: FaultKind::Delay(ms(3)), ..drop }));
        for still_heard in [
            Fault { direction: Direction::FromController, ..drop },
            Fault { every: 2, ..drop },
            Fault { kind: FaultKind::Babble, ..drop },
        ] {
            assert!(!outlasts(still_heard), "{still_heard:?}");
        }
    }
}
