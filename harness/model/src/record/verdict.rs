//! Defines verdicts and their causes: exclusions, excuses, violations and missing values.

use crate::metrics::{Metric, MissingValue};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;
use thiserror::Error;

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema, strum::IntoStaticStr, strum::Display,
)]
#[strum(const_into_str, serialize_all = "lowercase")]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    Pass,
    Fail,
    Inconclusive,
}

impl Verdict {
    /// Fails if any fails, passes if all pass, and is otherwise, or without any, inconclusive.
    pub fn combine(verdicts: impl IntoIterator<Item = Self>) -> Self {
        verdicts
            .into_iter()
            .reduce(|a, b| match (a, b) {
                (Self::Fail, _) | (_, Self::Fail) => Self::Fail,
                (Self::Pass, Self::Pass) => Self::Pass,
                _ => Self::Inconclusive,
            })
            .unwrap_or(Self::Inconclusive)
    }

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

/// Numbers of verdicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, JsonSchema)]
#[schemars(rename = "Counts")]
pub struct VerdictCounts {
    pub passed: usize,
    pub failed: usize,
    pub inconclusive: usize,
}

impl VerdictCounts {
    pub const fn total(self) -> usize {
        self.passed + self.failed + self.inconclusive
    }

    pub const fn add(&mut self, verdict: Verdict) {
        match verdict {
            Verdict::Pass => self.passed += 1,
            Verdict::Fail => self.failed += 1,
            Verdict::Inconclusive => self.inconclusive += 1,
        }
    }
}

impl FromIterator<Verdict> for VerdictCounts {
    fn from_iter<I: IntoIterator<Item = Verdict>>(verdicts: I) -> Self {
        let mut counts = Self::default();
        verdicts.into_iter().for_each(|verdict| counts.add(verdict));
        counts
    }
}

impl fmt::Display for VerdictCounts {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} passed, {} failed, {} inconclusive", self.passed, self.failed, self.inconclusive)
    }
}

/// Why a verdict is inconclusive.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema, strum::Display,
)]
#[strum(serialize_all = "lowercase")]
#[serde(rename_all = "lowercase")]
pub enum Cause {
    /// The link to the controller, or its delay.
    Rig,
    /// The bench itself was too late or lost a row.
    Bench,
    /// No controller can meet the demand.
    Infeasible,
    /// Too few trials for the confidence, or missing traces.
    Evidence,
}

/// Instants are in ms after the start of the trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum Exclusion {
    #[error("no answer at {at_ms} ms")]
    NoAnswer { at_ms: f64 },
    #[error("the bench was too late {count}×, first at {first_ms} ms")]
    LateBench { count: usize, first_ms: f64 },
    /// The controller's timer is off by more than an oscillator can be.
    #[error("the controller's clock differs by {:+.0} % from the bench's: \
        its periods are not the scenario's", ppm / 1e4)]
    WrongClock {
        /// Positive if the controller's clock is fast, parts per million.
        ppm: f64,
    },
    #[error("{count} rows were lost between control loop and trace")]
    LostRows { count: u64 },
    #[error("the trace starts at {at_ms} ms")]
    LateStart { at_ms: f64 },
    #[error("no rows between {from_ms} and {to_ms} ms, expected one every {step_ms} ms")]
    Gap { from_ms: f64, to_ms: f64, step_ms: f64 },
    #[error("the trace ends at {at_ms} ms instead of {duration_ms} ms")]
    EarlyEnd { at_ms: f64, duration_ms: f64 },
    #[error("the run was cut off before this trial was complete")]
    CutOff,
    #[error("its trace is missing")]
    MissingTrace,
    #[error("the bench was too late with a setpoint at {at_ms} ms")]
    LateSetpoint { at_ms: f64 },
    #[error("a setpoint was not acknowledged by {at_ms} ms")]
    Unacknowledged { at_ms: f64 },
    #[error("the telemetry starts at {at_ms} ms")]
    LateTelemetry { at_ms: f64 },
    #[error("no telemetry between {from_ms} and {to_ms} ms")]
    TelemetryGap { from_ms: f64, to_ms: f64 },
    #[error("the telemetry ends at {at_ms} ms instead of {duration_ms} ms")]
    EarlyTelemetryEnd { at_ms: f64, duration_ms: f64 },
    #[error("the controller held a setpoint of {held_um} µm at {at_ms} ms, expected {}", range(*sent_um))]
    WrongSetpoint {
        held_um: f64,
        at_ms: f64,
        /// Smallest and largest setpoint of the scenario around this instant, µm.
        sent_um: [f64; 2],
    },
    #[error("{why}")]
    ConditionsNotMade { why: String },
    #[error("finger or temperature change within a trial of {duration_ms} ms, which is too short for an operator")]
    TooFastForOperator { duration_ms: f64 },
    #[error("finger and temperature of this trial were neither measured nor confirmed by an operator")]
    UnknownConditions,
    #[error(
        "the finger pressed with {force_n:.2} N at {at_ms} ms, expected {}; {wrong_rows} of {rows} rows have another \
         force",
        range(*expected_n)
    )]
    WrongForce {
        force_n: f64,
        at_ms: f64,
        /// Smallest and largest force of the scenario around this instant, N.
        expected_n: [f64; 2],
        wrong_rows: usize,
        rows: usize,
    },
}

fn range([low, high]: [f64; 2]) -> String {
    if low == high { format!("{low}") } else { format!("{low} to {high}") }
}

impl Exclusion {
    pub const fn cause(&self) -> Cause {
        match self {
            Self::LateBench { .. }
            | Self::LostRows { .. }
            | Self::LateStart { .. }
            | Self::Gap { .. }
            | Self::EarlyEnd { .. }
            | Self::CutOff
            | Self::LateSetpoint { .. } => Cause::Bench,
            Self::MissingTrace => Cause::Evidence,
            Self::NoAnswer { .. }
            | Self::WrongClock { .. }
            | Self::Unacknowledged { .. }
            | Self::LateTelemetry { .. }
            | Self::TelemetryGap { .. }
            | Self::EarlyTelemetryEnd { .. }
            | Self::WrongSetpoint { .. }
            | Self::ConditionsNotMade { .. }
            | Self::TooFastForOperator { .. }
            | Self::UnknownConditions
            | Self::WrongForce { .. } => Cause::Rig,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Error)]
#[serde(rename_all = "snake_case")]
pub enum Excuse {
    #[error(
        "saturated: holding the setpoint needs {needed_vpp:.0} Vpp, \
         the amplifier gives {limit_vpp:.0} Vpp: at best {best}"
    )]
    SetpointOutOfReach {
        /// Drive that holds the setpoint at resonance.
        needed_vpp: f64,
        limit_vpp: f64,
        best: BestResponse,
    },
    #[error("saturated: from 0 to {limit_vpp:.0} Vpp no controller does better than {best}")]
    DriveLimited { limit_vpp: f64, best: BestResponse },
    #[error(
        "the drive was at its limit at {at_ms} ms; for a real plate the bench cannot compute whether another \
         controller would do better"
    )]
    SaturatedRealPlate { at_ms: f64 },
    #[error(
        "trial {trial}: at this rig's loop delay of {typical_us:.0} µs (longest {longest_us:.0} µs) the law itself \
         gets {}, without it {}; a slower --time-scale makes the delay smaller",
        value(*delayed),
        value(*undelayed)
    )]
    LoopDelay { trial: u32, typical_us: f64, longest_us: f64, delayed: Option<f64>, undelayed: Option<f64> },
    #[error(
        "trial {trial}: the loop delay was up to {longest_us:.0} µs, more than a tenth of the control period \
         ({limit_us:.0} µs), and the bench cannot compute its effect on an own law; --clock lockstep decides, and a \
         slower --time-scale makes the delay smaller"
    )]
    OwnLawDelay { trial: u32, longest_us: f64, limit_us: f64 },
    #[error("in real time the loop delay includes line and bench, not the controller alone")]
    RealTimeDelay,
}

impl Excuse {
    pub const fn cause(&self) -> Cause {
        match self {
            Self::SetpointOutOfReach { .. } | Self::DriveLimited { .. } => Cause::Infeasible,
            Self::SaturatedRealPlate { .. } => Cause::Evidence,
            Self::LoopDelay { .. } | Self::OwnLawDelay { .. } | Self::RealTimeDelay => Cause::Rig,
        }
    }
}

fn value(value: Option<f64>) -> String {
    value.map_or_else(|| "no value".to_owned(), |value| format!("{value:.3}"))
}

/// What the best possible controller reaches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BestResponse {
    Value(Metric, f64),
    /// Mean over the window, percent of the setpoint.
    Mean(f64),
    Missing(MissingValue),
}

impl fmt::Display for BestResponse {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Value(metric, value) => write!(formatter, "{metric} {value:.3}"),
            Self::Mean(percent) => write!(formatter, "a mean of {percent:.3} % of the setpoint"),
            Self::Missing(missing) => write!(formatter, "a signal that {missing}"),
        }
    }
}

/// All violations of one kind in a trial.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Violation {
    pub kind: ViolationKind,
    pub at_s: f64,
    pub count: u64,
    /// Worst value, Vpp, Hz or percent, or the bytes of the first rejected frame; absent if the kind has no value or the value was not
    /// finite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worst: Option<f64>,
    /// Limit in the unit of `worst`, or the expected length of the frame.
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
    /// A frame of the controller with a wrong CRC, wrong COBS or no message of the protocol, on a
    /// line that loses no byte.
    RejectedFrame,
    /// A control step that takes longer than the control period on the emulated chip, percent of
    /// the period. A scenario with an expectation of `step_time_percent` has its own limit.
    StepTime,
    /// A configuration refused that the page of the protocol calls usable.
    RefusedConfiguration,
    /// A message of the controller that no request caused and that the page of the protocol does not
    /// allow, on a line that loses no byte.
    UnrequestedMessage,
}

impl ViolationKind {
    pub const COUNT: usize = 15;

    /// True if only the number of violations is known, not the instant of the first one.
    const fn is_counted(self) -> bool {
        matches!(
            self,
            Self::WrongSequence
                | Self::SecondReply
                | Self::IgnoredSafe
                | Self::UnrequestedSafe
                | Self::RejectedFrame
                | Self::UnrequestedMessage
        )
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, at_s, count, worst, limit } = *self;
        let worst =
            |unit| worst.map_or_else(|| "a value that is not finite".to_owned(), |value| format!("{value} {unit}"));
        let (limit, worst_value) = (limit.unwrap_or(f64::NAN), self.worst);
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
            ViolationKind::RejectedFrame => {
                let length = |bytes| format!("frame of the controller rejected, {bytes} bytes");
                match worst_value {
                    Some(bytes) if bytes != limit => write!(formatter, "{} instead of {limit}", length(bytes)),
                    Some(bytes) => write!(formatter, "{}: its CRC, COBS or message is wrong", length(bytes)),
                    None => write!(formatter, "frame of the controller rejected: its CRC, COBS or message is wrong"),
                }
            }
            ViolationKind::UnrequestedMessage => write!(formatter, "message of the controller without a request"),
            ViolationKind::RefusedConfiguration => write!(formatter, "usable configuration refused"),
            ViolationKind::StepTime => write!(
                formatter,
                "the longest control step takes {:.1} % of the control period on the emulated chip, limit {limit} %",
                worst_value.unwrap_or(f64::NAN)
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
    fn names_the_length_of_a_rejected_frame() {
        let violation =
            |worst, limit| Violation { kind: ViolationKind::RejectedFrame, at_s: 0.06, count: 2, worst, limit };
        for (worst, limit, expected) in [
            (Some(23.0), Some(24.0), "frame of the controller rejected, 23 bytes instead of 24, 2 up to 60.0 ms"),
            (
                Some(24.0),
                Some(24.0),
                "frame of the controller rejected, 24 bytes: its CRC, COBS or message is wrong, 2 up to 60.0 ms",
            ),
            (None, None, "frame of the controller rejected: its CRC, COBS or message is wrong, 2 up to 60.0 ms"),
        ] {
            assert_eq!(violation(worst, limit).to_string(), expected);
        }
    }

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
