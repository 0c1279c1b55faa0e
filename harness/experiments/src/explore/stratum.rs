//! Assigns each scene number to a stratum, so that few scenes cover event kinds, periods, limits
//! and histories.

use crate::explore::event_kind::EventKind;

/// Properties of a scene that its number determines. All other properties are drawn.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::struct_excessive_bools, reason = "independent choices")]
pub(crate) struct Stratum {
    /// Choice of the control period. 0: usual; 1: shortest; 2: longest; larger numbers: drawn.
    pub(crate) period: u64,
    /// Choice of the drive limit. 0: largest; 1: smallest; larger numbers: drawn.
    pub(crate) limit: u64,
    /// Kinds of the first two events.
    pub(crate) kinds: Vec<EventKind>,
    pub(crate) has_history: bool,
    pub(crate) has_noise: bool,
    /// True if the configuration has its own response time, gains, frequency range or slew limit.
    pub(crate) is_tuned: bool,
    pub(crate) has_fault: bool,
    /// True if setpoints of the judged trial may exceed the reach of the drive limit.
    pub(crate) is_overloaded: bool,
    /// True if setpoints of the earlier trials may exceed the reach of the drive limit.
    pub(crate) is_overloaded_before: bool,
    pub(crate) is_long: bool,
    pub(crate) sine: Option<SineOf>,
    /// True if time stamps of later plays pass 2^16 ms, 2^31 µs and 2^32 µs (counter overflows).
    pub(crate) shifts_time: bool,
    /// Number of the scene, if scripts of messages precede the trial. This is rare, because the
    /// scripts take as long as a hundred scenes.
    pub(crate) scripts: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SineOf {
    Force,
    Temperature,
}

const PAIRS: u64 = (EventKind::ALL.len() * EventKind::ALL.len()) as u64;
/// Has no common divisor with [`PAIRS`], so 64 scenes contain all pairs of event kinds.
const PAIR_STRIDE: u64 = 37;
const LONG_EVERY: u64 = 41;
const SINE_EVERY: u64 = 17;
const SCRIPTS_EVERY: u64 = 512;

impl Stratum {
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

    /// Stratum of the configuration of an earlier trial.
    pub(crate) fn any_configuration(&self) -> Self {
        Self { period: u64::MAX, limit: u64::MAX, is_tuned: true, ..self.clone() }
    }
}
