//! Encodes and decodes a message with its sequence number.
//!
//! A body starts with two bytes. The first contains the version (upper four bits) and the kind
//! (lower four bits), the second is the sequence number. An answer repeats the sequence number of
//! its request. All numbers are little-endian, floats are IEEE 754 binary32, amplitudes and
//! voltages are peak to peak.
//!
//! | kind | message | from | body bytes |
//! |---|---|---|---|
//! | 1 | [`Message::Hello`] | bench | 2 |
//! | 2 | [`Identity`] | target | 50 |
//! | 3 | [`Configure`] | bench | 54, or 58 with a loop delay |
//! | 4 | [`Configured`] | target | 20 |
//! | 5 | [`Sample`] | bench | 18 |
//! | 6 | [`Command`] | target | 18 |
//! | 7 | [`Message::Safe`] | bench | 2 |
//! | 8 | [`FaultReport`] | target | 20 |
//! | 9 | [`Tick`] | target | 6 |
//! | 10 | [`Setpoint`] | bench | 6 |
//! | 11 | [`Telemetry`] | target | 37 |

use crate::configuration::{Configure, Configured};
use crate::control::{Command, FaultReport, Sample, Setpoint, Telemetry, Tick};
use crate::field::{MessageError, Reader, Writer};
use crate::frame::EncodedFrame;
use crate::identity::Identity;

pub const VERSION: u8 = 1;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Packet {
    /// The bench increments this number per message, modulo 256, and answers repeat it. Ticks and
    /// telemetry have their own counters.
    pub sequence: u8,
    pub message: Message,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Message {
    Hello,
    Identity(Identity),
    /// Starts a trial and ends the states `Fault` and `Safe`.
    Configure(Configure),
    Configured(Configured),
    Sample(Sample),
    Command(Command),
    /// Requests 0 V until the next `Configure`. The answer is a `Command` with 0 V in state `Safe`.
    Safe,
    /// Reports a crash of the processor. The target sends it once, with the drive already at 0 V.
    Fault(FaultReport),
    /// Starts a control period if the target paces the control.
    Tick(Tick),
    /// Setpoint for a target that drives its own plate. The answer is a `Command`.
    Setpoint(Setpoint),
    /// One period of the target's own plate.
    Telemetry(Telemetry),
}

impl Message {
    fn kind(&self) -> u8 {
        match self {
            Self::Hello => 1,
            Self::Identity(_) => 2,
            Self::Configure(_) => 3,
            Self::Configured(_) => 4,
            Self::Sample(_) => 5,
            Self::Command(_) => 6,
            Self::Safe => 7,
            Self::Fault(_) => 8,
            Self::Tick(_) => 9,
            Self::Setpoint(_) => 10,
            Self::Telemetry(_) => 11,
        }
    }

    /// True if the target sends the message without a request, with its own sequence number.
    pub const fn is_unsolicited(&self) -> bool {
        matches!(self, Self::Tick(_) | Self::Telemetry(_))
    }
}

impl Packet {
    pub fn encode(&self) -> EncodedFrame {
        let mut writer = Writer::new();
        writer.write(&[VERSION << 4 | self.message.kind(), self.sequence]);
        match &self.message {
            Message::Hello | Message::Safe => {}
            Message::Identity(identity) => writer.write(identity),
            Message::Configure(configure) => writer.write(configure),
            Message::Configured(configured) => writer.write(configured),
            Message::Sample(sample) => writer.write(sample),
            Message::Command(command) => writer.write(command),
            Message::Fault(report) => writer.write(report),
            Message::Tick(tick) => writer.write(tick),
            Message::Setpoint(setpoint) => writer.write(setpoint),
            Message::Telemetry(telemetry) => writer.write(telemetry),
        }
        // `Writer` holds at most `MAX_BODY` bytes, and each body of this length fits in a frame.
        match EncodedFrame::new(writer.body()) {
            Some(frame) => frame,
            None => unreachable!(),
        }
    }

    pub fn decode(body: &[u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(body);
        let first: u8 = reader.read()?;
        if first >> 4 != VERSION {
            return Err(MessageError::Version(first >> 4));
        }
        let sequence = reader.read()?;
        let message = match first & 0x0f {
            1 => Message::Hello,
            2 => Message::Identity(reader.read()?),
            3 => Message::Configure(reader.read()?),
            4 => Message::Configured(reader.read()?),
            5 => Message::Sample(reader.read()?),
            6 => Message::Command(reader.read()?),
            7 => Message::Safe,
            8 => Message::Fault(reader.read()?),
            9 => Message::Tick(reader.read()?),
            10 => Message::Setpoint(reader.read()?),
            11 => Message::Telemetry(reader.read()?),
            kind => return Err(MessageError::Kind(kind)),
        };
        if reader.is_at_end() { Ok(Self { sequence, message }) } else { Err(MessageError::Length) }
    }
}

#[cfg(test)]
mod tests;
