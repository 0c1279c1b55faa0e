//! Defines planned faults of line, sensor and chip (`docs/scenarios.md`); `platebench-rig` applies
//! them. Only the emulated rig can apply faults of the chip.

use platebench_plate::Time;

#[derive(Debug, Clone, Copy, PartialEq, strum::EnumCount, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum FaultKind {
    Drop,
    /// Flips one bit, possibly of the delimiter.
    Flip,
    Duplicate,
    Delay(Time),
    /// Loses the second half of the message, with the delimiter.
    Truncate,
    /// Sends four invalid frames, 64 bytes, before the message.
    Babble,
    /// Loses all messages in the window.
    Disconnect,
    /// Keeps Wd and Wq of the last sample before the window.
    Freeze,
    /// Multiplies Wd and Wq.
    Scale(f64),
}

impl FaultKind {
    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub const fn affects_sensor(self) -> bool {
        matches!(self, Self::Freeze | Self::Scale(_))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "kebab-case")]
pub enum Direction {
    ToController,
    FromController,
    /// Samples to the controller and commands from it, counted separately.
    #[default]
    Both,
}

impl Direction {
    pub const ALL: [Self; 3] = [Self::ToController, Self::FromController, Self::Both];

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

/// Instants count from the start of the trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    pub kind: FaultKind,
    pub from: Time,
    /// End of the fault, exclusive. It is `None` for a line that stays disconnected.
    pub until: Option<Time>,
    pub direction: Direction,
    /// Affects every n-th message per direction in the window; 0 affects none.
    pub every: u32,
    /// Seed of random effects. If it is `None`, the seed of the trial applies.
    pub seed: Option<u64>,
    pub reconfigure: bool,
}

impl Fault {
    pub fn is_active_at(&self, time: Time) -> bool {
        self.from <= time && self.until.is_none_or(|until| time < until)
    }

    /// True if the fault can cause a missing answer or a stop at `time`. The effect outlasts the
    /// window by one period, because a frame without a delimiter destroys the next one, and by the
    /// delay of delayed messages. A permanent disconnection explains nothing, because the
    /// controller is lost.
    pub fn can_explain(&self, time: Time, period: Time) -> bool {
        let delay = match self.kind {
            FaultKind::Delay(delay) => delay,
            _ => Time::ZERO,
        };
        self.until.is_some_and(|until| self.from <= time && time < until + period + delay)
    }

    /// True if the fault loses messages or delays them by at least a period, and
    /// [`Self::can_explain`] is true.
    pub fn can_explain_silence(&self, time: Time, period: Time) -> bool {
        let loses = match self.kind {
            FaultKind::Drop | FaultKind::Flip | FaultKind::Truncate | FaultKind::Disconnect => true,
            FaultKind::Delay(delay) => delay.times(if self.direction == Direction::Both { 2 } else { 1 }) >= period,
            FaultKind::Duplicate | FaultKind::Babble | FaultKind::Freeze | FaultKind::Scale(_) => false,
        };
        loses && self.can_explain(time, period)
    }

    pub fn exceeds_watchdog(&self, timeout: Time, period: Time) -> bool {
        let silent = match self.kind {
            FaultKind::Delay(delay) => Some(delay),
            FaultKind::Drop | FaultKind::Disconnect => self.until.map(|until| until - self.from),
            _ => return false,
        };
        // The watchdog counts from the last sample, which arrived one period before the window.
        self.direction != Direction::FromController
            && self.every == 1
            && silent.is_none_or(|silent| silent + period >= timeout)
    }
}

/// `ClockDrift` is the frequency error in parts per million, positive if the clocks are fast. If
/// the `bit` of a `BitFlip` is `None`, the trial's seed selects the bit.
#[derive(Debug, Clone, PartialEq, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "kebab-case")]
pub enum ChipFaultKind {
    BitFlip { target: BitFlipTarget, bit: Option<u32> },
    Reset,
    PowerCut,
    ClockDrift(f64),
    Hang,
    Stuck { address: u32, value: u32 },
}

impl ChipFaultKind {
    pub const fn name(&self) -> &'static str {
        self.into_str()
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BitFlipTarget {
    Ram {
        start: u32,
        length: u32,
    },
    /// Name of an ELF symbol, mangled or demangled.
    Variable(String),
    /// Register number: 0 to 12 are r0 to r12, 13 is sp, 14 is lr, 15 is pc.
    Register(usize),
}

impl BitFlipTarget {
    pub const EXPECTED: &'static str = "\"ram:0x20000000+4096\", \"variable:NAME\" or \"register:r4\"";

    pub fn parse(text: &str) -> Option<Self> {
        let (kind, name) = text.split_once(':')?;
        match kind {
            "ram" => {
                let (start, length) = name.split_once('+')?;
                let (start, length) = (parse_address(start)?, parse_address(length)?);
                (length > 0 && start.checked_add(length).is_some()).then_some(Self::Ram { start, length })
            }
            "variable" if !name.is_empty() => Some(Self::Variable(name.to_owned())),
            "register" => match name {
                "sp" => Some(Self::Register(13)),
                "lr" => Some(Self::Register(14)),
                "pc" => Some(Self::Register(15)),
                _ => {
                    let number = name.strip_prefix('r')?.parse().ok()?;
                    (number <= 12).then_some(Self::Register(number))
                }
            },
            _ => None,
        }
    }
}

pub(crate) fn parse_address(text: &str) -> Option<u32> {
    text.strip_prefix("0x").map_or_else(|| text.parse().ok(), |digits| u32::from_str_radix(digits, 16).ok())
}

#[derive(Debug, Clone, PartialEq)]
pub struct ChipFault {
    pub kind: ChipFaultKind,
    /// Instant of the fault. If it is `None`, the trial's seed selects the instant.
    pub at: Option<Time>,
}

impl ChipFault {
    pub const fn is_random(&self) -> bool {
        self.at.is_none() || matches!(self.kind, ChipFaultKind::BitFlip { bit: None, .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silence_counts_from_the_last_sample() {
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
        // The last sample arrives at 39 ms, the next one at 44 ms.
        let exceeds = |fault: Fault| fault.exceeds_watchdog(ms(5), ms(1));
        assert!(exceeds(drop));
        assert!(!exceeds(Fault { until: until(ms(4) - Time::from_nanos(1)), ..drop }));
        assert!(exceeds(Fault { kind: FaultKind::Disconnect, until: None, direction: Direction::Both, ..drop }));
        assert!(exceeds(Fault { kind: FaultKind::Delay(ms(4)), ..drop }));
        assert!(!exceeds(Fault { kind: FaultKind::Delay(ms(3)), ..drop }));
        for unaffected in [
            Fault { direction: Direction::FromController, ..drop },
            Fault { every: 2, ..drop },
            Fault { kind: FaultKind::Babble, ..drop },
        ] {
            assert!(!exceeds(unaffected), "{unaffected:?}");
        }
    }
}

#[cfg(test)]
mod chip_fault_tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case("ram:0x20000000+4096", Some(BitFlipTarget::Ram { start: 0x2000_0000, length: 4096 }))]
    #[case("variable:integral", Some(BitFlipTarget::Variable("integral".to_owned())))]
    #[case("register:r4", Some(BitFlipTarget::Register(4)))]
    #[case("register:pc", Some(BitFlipTarget::Register(15)))]
    #[case("register:r13", None)]
    #[case("ram:0x20000000+0", None)]
    #[case("ram:0xffffffff+2", None)]
    #[case("variable:", None)]
    #[case("flash:0x08000000+4", None)]
    fn reads_the_target_of_a_bit_flip(#[case] text: &str, #[case] target: Option<BitFlipTarget>) {
        assert_eq!(BitFlipTarget::parse(text), target);
    }
}
