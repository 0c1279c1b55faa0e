//! Defines the messages of a scenario: a sequence that the bench plays before the trial and whose
//! answers `protocol_differences` compares. `docs/wire-protocol.md` contains the rules.

use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::load::Checker;
use platebench_plate::is_default;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub(crate) const MAX_MESSAGES: usize = 1_000;
/// Largest number of messages of a sequence, repetitions included.
pub(crate) const MAX_PLAYED: u64 = 2_000_000;
/// Longest wait, ms: the watchdog timeout has 16 bits.
const MAX_WAIT_MS: f64 = 70_000.0;
const MAX_BODY_BYTES: usize = 64;
const MAX_LINE_BYTES: usize = 1_024;
/// Number of the last law of the protocol.
const LAST_LAW: u8 = 8;
/// Last byte of a sample's frame before its delimiter.
const LAST_FRAME_BYTE: u8 = 22;

/// A number of a message. TOML's `nan` and `inf` are written as text.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected a number, \"nan\", \"inf\" or \"-inf\"")]
pub enum WireNumber {
    Finite(f64),
    NonFinite(NonFinite),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum NonFinite {
    #[serde(rename = "nan")]
    Nan,
    #[serde(rename = "inf")]
    Infinity,
    #[serde(rename = "-inf")]
    NegativeInfinity,
}

impl WireNumber {
    pub const fn value(self) -> f32 {
        match self {
            Self::Finite(value) => value as f32,
            Self::NonFinite(NonFinite::Nan) => f32::NAN,
            Self::NonFinite(NonFinite::Infinity) => f32::INFINITY,
            Self::NonFinite(NonFinite::NegativeInfinity) => f32::NEG_INFINITY,
        }
    }
}

impl From<f32> for WireNumber {
    fn from(value: f32) -> Self {
        match value {
            value if value.is_nan() => Self::NonFinite(NonFinite::Nan),
            f32::INFINITY => Self::NonFinite(NonFinite::Infinity),
            f32::NEG_INFINITY => Self::NonFinite(NonFinite::NegativeInfinity),
            // The shortest text of the f32, not of its f64.
            value => Self::Finite(value.to_string().parse().unwrap_or(f64::from(value))),
        }
    }
}

/// Changes of the scenario's configuration; the watchdog timeout is 1000 ms by default.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ConfigurationChange {
    /// Number of the law.
    #[schemars(range(max = LAST_LAW))]
    pub law: Option<u8>,
    pub watchdog_timeout_ms: Option<u16>,
    pub period_us: Option<u32>,
    pub start_frequency_mhz: Option<u32>,
    pub gain_um_per_vpp: Option<WireNumber>,
    pub time_constant_s: Option<WireNumber>,
    pub response_time_s: Option<WireNumber>,
    pub drive_limit_vpp: Option<WireNumber>,
    pub frequency_range_hz: Option<WireNumber>,
    pub frequency_slew_hz: Option<WireNumber>,
    /// Kp and Ki of the amplitude loop, Kp and Ki of the frequency loop.
    pub gains: Option<[WireNumber; 4]>,
    pub loop_delay_us: Option<u32>,
    /// Bit 1 of the flags: the controller sends ticks.
    #[serde(skip_serializing_if = "is_default")]
    pub paced_by_target: bool,
    /// Bit 3 of the flags: the controller drives its own plate.
    #[serde(skip_serializing_if = "is_default")]
    pub own_plate: bool,
}

/// A message of a sequence, or a step between messages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ScenarioMessage {
    /// Keys that are not given have the value of the scenario.
    Configure(ConfigurationChange),
    Sample {
        setpoint_um: WireNumber,
        wd_um: WireNumber,
        wq_um: WireNumber,
        /// Distance of the sequence number from that of the last message; 0 repeats it.
        #[serde(default = "one", skip_serializing_if = "is_one")]
        #[schemars(extend("default" = 1))]
        ahead: u8,
        /// Sends the frame in two pieces; the first has this number of bytes.
        #[schemars(range(min = 1, max = LAST_FRAME_BYTE + 1))]
        split_at: Option<u8>,
    },
    /// The bytes of the last sample again.
    Repeat {},
    Hello {},
    Safe {},
    /// Silence.
    Wait {
        #[schemars(range(min = 0.0, max = MAX_WAIT_MS))]
        ms: f64,
    },
    /// The answers so far, without a further message. The next message waits for them.
    Compare {},
    /// A frame with a valid CRC. `nn` in its bytes is the next sequence number. If the controller
    /// answers it, `compare` follows.
    Body {
        hex: String,
    },
    /// Bytes on the line that the controller does not answer.
    Bytes {
        hex: String,
    },
    /// A sample with one flipped bit in this byte of its frame.
    Damaged {
        #[schemars(range(max = LAST_FRAME_BYTE))]
        byte: u8,
    },
    /// Plays the last `messages` messages `times` more times.
    Again {
        #[schemars(range(min = 1))]
        messages: u32,
        #[schemars(range(min = 1, max = MAX_PLAYED))]
        times: u32,
    },
}

const fn one() -> u8 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the type that serde requires")]
const fn is_one(value: &u8) -> bool {
    *value == 1
}

impl ScenarioMessage {
    pub fn sample(setpoint_um: f32, wd_um: f32, wq_um: f32) -> Self {
        let [setpoint_um, wd_um, wq_um] = [setpoint_um, wd_um, wq_um].map(WireNumber::from);
        Self::Sample { setpoint_um, wd_um, wq_um, ahead: 1, split_at: None }
    }

    /// True if a body contains its sequence number as `nn`.
    pub fn has_number(hex: &str) -> bool {
        hex.contains("nn")
    }

    /// Bytes of a text in hexadecimal; spaces may separate them. `nn` is the byte `number`, and
    /// invalid without a number.
    pub fn bytes_of(hex: &str, number: Option<u8>) -> Option<Vec<u8>> {
        let hex = number.map_or_else(|| hex.to_owned(), |number| hex.replace("nn", &format!("{number:02x}")));
        let digits = hex.chars().filter(|digit| *digit != ' ').map(|digit| digit.to_digit(16));
        let digits: Vec<u32> = digits.collect::<Option<_>>()?;
        let bytes = digits.chunks_exact(2).map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | *digit as u8));
        digits.len().is_multiple_of(2).then(|| bytes.collect())
    }

    /// Number of messages that a sequence plays, repetitions included.
    pub fn count(messages: &[Self]) -> u64 {
        let count = |message: &Self| match message {
            Self::Again { messages, times } => u64::from(*messages) * u64::from(*times),
            _ => 1,
        };
        messages.iter().map(count).sum()
    }
}

impl Checker<'_> {
    /// Checks the relations of `messages`. The schema contains the bounds of each number.
    pub(crate) fn check_messages(&self, messages: &[ScenarioMessage], is_compared: bool) -> Result<(), Diagnostic> {
        let Some(first) = messages.first() else { return Ok(()) };
        self.require(messages.len() <= MAX_MESSAGES, "message", || {
            format!("{} [[message]], expected at most {MAX_MESSAGES}", messages.len())
        })?;
        self.require(
            is_compared,
            "message",
            || "[[message]] without an expectation for its answers, expected [[expect]] with protocol_differences",
        )?;
        let is_known = matches!(
            first,
            ScenarioMessage::Configure(_)
                | ScenarioMessage::Hello {}
                | ScenarioMessage::Safe {}
                | ScenarioMessage::Sample { split_at: None, .. }
        );
        self.require(
            is_known,
            "message.0.kind",
            || "the first message, expected `configure`, or `hello`, `safe` or `sample` to a new controller",
        )?;
        let played = ScenarioMessage::count(messages);
        self.require(played <= MAX_PLAYED, "message", || {
            format!("{played} messages with repetitions, expected at most {MAX_PLAYED}")
        })?;
        let is_again = |message: &ScenarioMessage| matches!(message, ScenarioMessage::Again { .. });
        for (index, message) in messages.iter().enumerate() {
            let key = |key: &str| format!("message.{index}.{key}");
            match message {
                ScenarioMessage::Again { messages: count, .. } => {
                    let start = index.checked_sub(*count as usize);
                    let repeated = start.and_then(|start| messages.get(start..index));
                    self.require(repeated.is_some_and(|all| !all.iter().any(is_again)), &key("messages"), || {
                        format!("{count}, expected at most as many as there are since the last `again`")
                    })?;
                }
                ScenarioMessage::Body { hex } | ScenarioMessage::Bytes { hex } => {
                    let is_body = matches!(message, ScenarioMessage::Body { .. });
                    let most = if is_body { MAX_BODY_BYTES } else { MAX_LINE_BYTES };
                    let count = ScenarioMessage::bytes_of(hex, is_body.then_some(0)).map_or(0, |bytes| bytes.len());
                    self.require((1..=most).contains(&count), &key("hex"), || {
                        format!("`{hex}`, expected 1 to {most} bytes of two hexadecimal digits each")
                    })?;
                }
                _ => {}
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case("15 0a", Some(vec![0x15, 0x0a]))]
    #[case("150A", Some(vec![0x15, 0x0a]))]
    #[case("150", None)]
    #[case("1g", None)]
    #[case("", Some(vec![]))]
    #[case("15 nn 0a", Some(vec![0x15, 0xf8, 0x0a]))]
    #[case("15 n 0a", None)]
    fn reads_hexadecimal_bytes(#[case] hex: &str, #[case] expected: Option<Vec<u8>>) {
        assert_eq!(ScenarioMessage::bytes_of(hex, Some(0xf8)), expected);
    }

    #[test]
    fn bytes_without_a_message_have_no_number() {
        assert_eq!(ScenarioMessage::bytes_of("15 nn", None), None);
    }

    #[rstest]
    #[case(0.1)]
    #[case(f32::INFINITY)]
    #[case(f32::NEG_INFINITY)]
    #[case(f32::MAX)]
    fn a_number_keeps_its_value(#[case] value: f32) {
        assert_eq!(WireNumber::from(value).value(), value);
        assert!(WireNumber::from(f32::NAN).value().is_nan());
    }
}
