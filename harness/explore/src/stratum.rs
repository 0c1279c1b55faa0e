//! Assigns each scene number to a stratum, so that few scenes cover kinds, periods, limits and histories.

use crate::event_kind::EventKind;

/// What the number of a scene fixes. Everything else is drawn.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::struct_excessive_bools, reason = "independent choices")]
pub(crate) struct Stratum {
    /// 0: usual; 1: shortest; 2: longest; otherwise drawn.
    pub(crate) period: u64,
    /// 0: largest; 1: smallest; otherwise drawn.
    pub(crate) limit: u64,
    /// The first two events.
    pub(crate) kinds: Vec<EventKind>,
    pub(crate) has_history: bool,
    pub(crate) has_noise: bool,
    /// The configuration has its own response time, gains, frequency range or slew limit.
    pub(crate) is_tuned: bool,
    pub(crate) has_fault: bool,
    /// The drive limit does not suffice for every setpoint.
    pub(crate) is_overloaded: bool,
    /// The same for the trials before.
    pub(crate) is_overloaded_before: bool,
    pub(crate) is_long: bool,
    /// Force or temperature follows a sine.
    pub(crate) sine: Option<SineOf>,
    /// The time stamps of further trials pass the ends of their counters.
    pub(crate) shifts_time: bool,
    /// Number of the scene if scripts of messages come before the trial; they take as long as a hundred scenes.
    pub(crate) scripts: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SineOf {
    Force,
    Temperature,
}

/// All pairs of kinds.
const PAIRS: u64 = (EventKind::ALL.len() * EventKind::ALL.len()) as u64;
/// Without a common divisor with [`PAIRS`]: neighbouring scenes differ in both kinds.
const PAIR_STRIDE: u64 = 37;
/// One scene of this many is long.
const LONG_EVERY: u64 = 41;
const SINE_EVERY: u64 = 17;
const SCRIPTS_EVERY: u64 = 512;

impl Stratum {
    /// The stratum of scene `index`.
    pub(crate) fn of(index: u64) -> Self {
        let pair = index.wrapping_mul(PAIR_STRIDE) % PAIRS;
        let kinds = EventKind::ALL.len() as u64;
        let kind = |number: u64| EventKind::ALL.get(number as usize).copied();
        Self {
            period: index % 5,
            limit: index % 4,
            kinds: [kind(pair / kinds), kind(pair % kinds)].into_iter().flatten().collect(),
            has_history: index % 3 == 1,
            has_noise: index % 7 == 5,
            is_tuned: index % 5 == 3,
            has_fault: index % 9 == 7,
            is_overloaded: index % 13 == 6,
            is_overloaded_before: index % 5 == 2,
            is_long: index % LONG_EVERY == 11,
            sine: match index % (2 * SINE_EVERY) {
                4 => Some(SineOf::Force),
                21 => Some(SineOf::Temperature),
                _ => None,
            },
            shifts_time: index % 6 == 2,
            scripts: index.is_multiple_of(SCRIPTS_EVERY).then_some(index),
        }
    }

    /// Configurations of earlier trials.
    pub(crate) fn any_configuration(&self) -> Self {
        Self { period: u64::MAX, limit: u64::MAX, is_tuned: true, ..self.clone() }
    }
}
