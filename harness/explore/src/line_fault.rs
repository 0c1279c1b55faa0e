//! Defines planned faults of the line in the judged trial.

use platebench_plate::Time;
use platebench_runner::wire_fault_kind;
use platebench_scenario::{Direction, FaultKind};
use proptest::prelude::{BoxedStrategy, Just, Strategy, any};
use proptest::prop_oneof;
use std::fmt::Write as _;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineFault {
    pub kind: FaultKind,
    pub direction: Direction,
    /// Start of the window, µs; a control instant.
    pub from_us: u32,
    pub until_us: u32,
    /// The fault applies to each n-th message of the direction in the window.
    pub every: u32,
}

/// A fault whose times are relative to a trial.
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

/// A rejected frame adds 2 to the controller's error counter, a sample subtracts 1, and the
/// controller stops at 10 (docs/wire-protocol.md). It stops in the 18th period if every second
/// frame is damaged, and never if every third is.
const UNTIL_STOP: std::ops::RangeInclusive<u32> = 14..=24;
const LONG_WINDOW: std::ops::RangeInclusive<u32> = 3..=24;
/// Number of consecutive damaged messages that cannot stop the controller, even if each splits its
/// frame in two.
const FEW_FLIPS: u32 = 2;
/// Control periods between two faults that lose messages, so that both together do not trigger the
/// watchdog.
const PERIODS_BETWEEN: u32 = 5;
/// Time in which a stopped controller is configured again, so that it runs at the end of the trial.
const MIN_PERIODS_AFTER: u32 = 8;
/// Control periods after a fault until limits apply, because the law must measure damping and
/// resonance again.
const RECOVERY_PERIODS: u32 = 60;

impl LineFaultDraw {
    pub(crate) fn strategy() -> BoxedStrategy<Self> {
        let kind = prop_oneof![
            // A fourth lost message would trigger the watchdog.
            6 => (Just(FaultKind::Drop), Just(1), 1..=3_u32),
            2 => (Just(FaultKind::Drop), 2..=3_u32, LONG_WINDOW),
            4 => (Just(FaultKind::Duplicate), 1..=2_u32, 2..=8_u32),
            2 => (Just(FaultKind::Flip), Just(1), 1..=FEW_FLIPS),
            2 => (Just(FaultKind::Flip), Just(2), UNTIL_STOP),
            1 => (Just(FaultKind::Flip), Just(3), LONG_WINDOW),
            1 => (Just(FaultKind::Truncate), Just(1), Just(1)),
            1 => (Just(FaultKind::Truncate), Just(3), LONG_WINDOW),
            2 => (Just(FaultKind::Delay(Time::ZERO)), Just(1), 1..=4_u32),
            // Noise or the watchdog stops the controller.
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

    /// True if the controller may stop and is then configured again.
    pub(crate) const fn may_stop(&self) -> bool {
        matches!(self.kind, FaultKind::Disconnect | FaultKind::Babble | FaultKind::Flip)
    }

    /// True if the instant of a stop depends on the controller's clock or on the content of
    /// messages.
    pub(crate) fn may_stop_differently(&self, period_us: u32) -> bool {
        match self.kind {
            FaultKind::Disconnect => true,
            FaultKind::Flip => self.until_us - self.from_us > FEW_FLIPS * period_us,
            _ => false,
        }
    }

    /// True if both faults can happen in one trial without a stop that neither causes alone.
    pub(crate) fn combines_with(&self, other: &Self, period_us: u32) -> bool {
        let gap_us = PERIODS_BETWEEN * period_us;
        let are_apart = self.until_us + gap_us <= other.from_us || other.until_us + gap_us <= self.from_us;
        are_apart || [self.kind, other.kind].contains(&FaultKind::Duplicate)
    }

    /// Largest number of control periods without an answer: the window, and the time until the
    /// repeated configuration.
    pub(crate) const fn longest_silence(&self, period_us: u32) -> u32 {
        (self.until_us - self.from_us) / period_us + 3
    }

    pub(crate) fn write(&self, text: &mut String) -> std::fmt::Result {
        let [from_ms, until_ms] = [self.from_us, self.until_us].map(|us| f64::from(us) / 1e3);
        let kind = wire_fault_kind(self.kind).name();
        writeln!(text, "\n[[fault]]\nkind = {kind:?}\nfrom_ms = {from_ms:?}\nuntil_ms = {until_ms:?}")?;
        writeln!(text, "direction = {:?}", self.direction.name())?;
        if self.every > 1 {
            writeln!(text, "every = {}", self.every)?;
        }
        match self.kind {
            FaultKind::Delay(delay) => writeln!(text, "delay_ms = {:?}", delay.seconds() * 1e3),
            FaultKind::Flip => writeln!(text, "seed = 1\nreconfigure = true"),
            FaultKind::Truncate | FaultKind::Babble | FaultKind::Disconnect => writeln!(text, "reconfigure = true"),
            _ => Ok(()),
        }
    }
}
