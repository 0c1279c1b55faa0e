//! Defines planned faults of the line in the judged trial.

use platebench_engine::wire_fault_kind;
use platebench_model::scenario::raw::RawFault;
use platebench_model::scenario::{Direction, FaultKind};
use platebench_plate::Time;
use proptest::prelude::{BoxedStrategy, Just, Strategy, any};
use proptest::prop_oneof;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineFault {
    pub kind: FaultKind,
    pub direction: Direction,
    /// Start of the window, µs. It is a control instant.
    pub from_us: u32,
    pub until_us: u32,
    /// The fault applies to each n-th message of the direction in the window.
    pub every: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LineFaultDraw {
    kind: FaultKind,
    /// Delay, percent of a period.
    delay: u32,
    to_controller: bool,
    /// Share of the trial before the fault, percent.
    at: u32,
    every: u32,
    /// Length of the window, control periods.
    length: u32,
}

/// Length, in control periods, of a window in which every second frame is damaged. A rejected frame
/// adds 2 to the controller's error counter, a sample subtracts 1, and the controller stops at 10
/// (docs/wire-protocol.md), here in period 18. If every third frame is damaged, it never stops.
const UNTIL_STOP: std::ops::RangeInclusive<u32> = 14..=24;
const LONG_WINDOW: std::ops::RangeInclusive<u32> = 3..=24;
/// Number of consecutive damaged messages that cannot stop the controller. Each may split its frame
/// in two, so they add at most 8 to the error counter.
const FEW_FLIPS: u32 = 2;
/// Control periods between faults that lose messages. Closer ones could trigger the watchdog.
const PERIODS_BETWEEN: u32 = 5;
/// Shortest time after a fault, control periods, so that a stopped controller runs again at the
/// end.
const MIN_PERIODS_AFTER: u32 = 8;
/// Control periods after a fault in which no limits apply, because the law measures the plate
/// again.
const RECOVERY_PERIODS: u32 = 60;

impl LineFaultDraw {
    pub(crate) fn strategy() -> BoxedStrategy<Self> {
        let kind = prop_oneof![
            // A fourth lost message in sequence would trigger the watchdog.
            6 => (Just(FaultKind::Drop), Just(1), 1..=3_u32),
            2 => (Just(FaultKind::Drop), 2..=3_u32, LONG_WINDOW),
            4 => (Just(FaultKind::Duplicate), 1..=2_u32, 2..=8_u32),
            2 => (Just(FaultKind::Flip), Just(1), 1..=FEW_FLIPS),
            2 => (Just(FaultKind::Flip), Just(2), UNTIL_STOP),
            1 => (Just(FaultKind::Flip), Just(3), LONG_WINDOW),
            1 => (Just(FaultKind::Truncate), Just(1), Just(1)),
            1 => (Just(FaultKind::Truncate), Just(3), LONG_WINDOW),
            2 => (Just(FaultKind::Delay(Time::ZERO)), Just(1), 1..=4_u32),
            // These two faults stop the controller, through its error counter or its watchdog.
            2 => (Just(FaultKind::Babble), Just(1), 3..=4_u32),
            2 => (Just(FaultKind::Disconnect), Just(1), 6..=9_u32),
        ];
        (kind, 20..=150_u32, any::<bool>(), 0..=90_u32)
            .prop_map(|((kind, every, length), delay, to_controller, at)| Self {
                kind,
                delay,
                to_controller,
                at,
                every,
                length,
            })
            .boxed()
    }

    pub(crate) fn place(self, duration_us: u32, period_us: u32) -> Option<LineFault> {
        let from_us = (duration_us / 100 * self.at).div_ceil(period_us) * period_us;
        let until_us = from_us + self.length * period_us;
        let kind = match self.kind {
            FaultKind::Delay(_) => FaultKind::Delay(Time::from_nanos(u64::from(period_us * self.delay) * 10)),
            kind => kind,
        };
        let direction = if self.to_controller { Direction::ToController } else { Direction::FromController };
        (until_us + MIN_PERIODS_AFTER * period_us <= duration_us).then_some(LineFault {
            kind,
            direction,
            from_us,
            until_us,
            every: self.every,
        })
    }
}

impl LineFault {
    /// Instant from which limits apply again, µs.
    pub(crate) const fn recovered_us(&self, period_us: u32) -> u32 {
        self.until_us + RECOVERY_PERIODS * period_us
    }

    /// True if the controller may stop. It is then configured again.
    pub(crate) const fn may_stop(&self) -> bool {
        matches!(self.kind, FaultKind::Disconnect | FaultKind::Babble | FaultKind::Flip)
    }

    /// True if the time of a stop depends on the controller's clock or on the bytes of messages.
    pub(crate) fn may_stop_differently(&self, period_us: u32) -> bool {
        match self.kind {
            FaultKind::Disconnect => true,
            FaultKind::Flip => self.until_us - self.from_us > FEW_FLIPS * period_us,
            _ => false,
        }
    }

    /// True if both faults can be in one trial without a stop that neither fault causes alone.
    pub(crate) fn combines_with(&self, other: &Self, period_us: u32) -> bool {
        let gap_us = PERIODS_BETWEEN * period_us;
        let are_apart = self.until_us + gap_us <= other.from_us || other.until_us + gap_us <= self.from_us;
        are_apart || [self.kind, other.kind].contains(&FaultKind::Duplicate)
    }

    /// Largest number of control periods without an answer, until the controller is configured
    /// again.
    pub(crate) const fn longest_silence(&self, period_us: u32) -> u32 {
        (self.until_us - self.from_us) / period_us + 3
    }

    pub(crate) fn raw(&self) -> RawFault {
        let [from_ms, until_ms] = [self.from_us, self.until_us].map(|us| Some(f64::from(us) / 1e3));
        let delay_ms = match self.kind {
            FaultKind::Delay(delay) => Some(delay.seconds() * 1e3),
            _ => None,
        };
        RawFault {
            kind: wire_fault_kind(self.kind).name().to_owned(),
            from_ms,
            until_ms,
            direction: Some(self.direction.name().to_owned()),
            every: (self.every > 1).then_some(self.every.into()),
            delay_ms,
            seed: matches!(self.kind, FaultKind::Flip).then_some(1),
            reconfigure: self.may_stop() || matches!(self.kind, FaultKind::Truncate),
            ..RawFault::default()
        }
    }
}
