//! Defines violations of the protocol and of the control period, which fail a trial independently
//! of its expectations.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// All violations of one kind in a trial.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Violation {
    pub kind: ViolationKind,
    pub at_s: f64,
    pub count: u64,
    /// Worst value, Vpp, Hz or percent; absent if the kind has no value or the value was not
    /// finite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worst: Option<f64>,
    /// Limit in the unit of `worst`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ViolationKind {
    DriveAboveLimit,
    DriveBelowZero,
    /// A frequency outside the configured range, Hz from the start frequency.
    FrequencyOutOfRange,
    /// A change of frequency above the configured slew, Hz per period.
    FrequencySlew,
    WrongSequence,
    SecondReply,
    WrongConfiguration,
    DriveAfterSafe,
    IgnoredSafe,
    ClockBackwards,
    /// A command in the state *safe* that no request for 0 V caused.
    UnrequestedSafe,
    /// A control step that takes longer than the control period on the emulated chip, percent of
    /// the period. A scenario with an expectation of `step_time_percent` has its own limit.
    StepTime,
}

impl ViolationKind {
    pub const COUNT: usize = 12;

    /// True if only the number of violations is known, not the instant of the first one.
    const fn is_counted(self) -> bool {
        matches!(self, Self::WrongSequence | Self::SecondReply | Self::IgnoredSafe | Self::UnrequestedSafe)
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, at_s, count, worst, limit } = *self;
        let worst =
            |unit| worst.map_or_else(|| "a value that is not finite".to_owned(), |value| format!("{value} {unit}"));
        let (limit, worst_percent) = (limit.unwrap_or(f64::NAN), self.worst);
        match kind {
            ViolationKind::DriveAboveLimit => {
                write!(formatter, "commanded drive of {} above the limit of {limit} Vpp", worst("Vpp"))
            }
            ViolationKind::DriveBelowZero => write!(formatter, "commanded drive of {} below 0", worst("Vpp")),
            ViolationKind::FrequencyOutOfRange => {
                write!(formatter, "commanded frequency {} from its start, limit {limit} Hz", worst("Hz"))
            }
            ViolationKind::FrequencySlew => {
                write!(formatter, "commanded frequency changed by {} per period, limit {limit} Hz", worst("Hz"))
            }
            ViolationKind::WrongSequence => write!(formatter, "reply with a sequence number that was not sent"),
            ViolationKind::SecondReply => write!(formatter, "second reply to one message"),
            ViolationKind::WrongConfiguration => {
                write!(formatter, "configuration answered with other gains or gains that are not finite")
            }
            ViolationKind::DriveAfterSafe => {
                write!(formatter, "commanded drive of {} after 0 V was confirmed", worst("Vpp"))
            }
            ViolationKind::IgnoredSafe => write!(formatter, "request for 0 V answered with a running state or a drive"),
            ViolationKind::ClockBackwards => write!(formatter, "time stamp of a command before that of the last one"),
            ViolationKind::UnrequestedSafe => {
                write!(formatter, "0 V confirmed without a request, or under the number of an answered sample")
            }
            ViolationKind::StepTime => write!(
                formatter,
                "the longest control step takes {:.1} % of the control period on the emulated chip, limit {limit} %",
                worst_percent.unwrap_or(f64::NAN)
            ),
        }?;
        let at_ms = at_s * 1e3;
        if kind.is_counted() {
            write!(formatter, ", {count} up to {at_ms:.1} ms")
        } else {
            write!(formatter, ", first at {at_ms:.1} ms, {count} in total")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn describes_value_limit_and_count() {
        let violation = Violation {
            kind: ViolationKind::DriveAboveLimit,
            at_s: 0.012,
            count: 3,
            worst: Some(1_200.0),
            limit: Some(900.0),
        };
        assert_eq!(
            violation.to_string(),
            "commanded drive of 1200 Vpp above the limit of 900 Vpp, first at 12.0 ms, 3 in total"
        );
    }
}
