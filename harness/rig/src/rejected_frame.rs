//! Measures the frames of a controller, to name the length of one that was rejected.

#[cfg(feature = "emulated")]
use platebench_wire::PacketReader;
use platebench_wire::{MAX_BODY, MAX_ENCODED, Message};
use std::fmt;

/// CRC, COBS byte and delimiter.
const OVERHEAD: usize = MAX_ENCODED - MAX_BODY;
// Bytes of the bodies, as in docs/wire-protocol.md.
const IDENTITY: usize = 50;
const CONFIGURED: usize = 20;
const COMMAND: usize = 18;

/// Lengths on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RejectedFrame {
    pub bytes: usize,
    /// Length of the answer to the last request.
    pub expected: usize,
}

impl RejectedFrame {
    /// Lengths without CRC, COBS byte and delimiter, as in docs/wire-protocol.md.
    pub(crate) fn bodies(&self) -> String {
        let [own, expected] = [self.bytes, self.expected].map(|bytes| bytes.saturating_sub(OVERHEAD));
        format!("a body of {own} instead of {expected} bytes")
    }
}

impl fmt::Display for RejectedFrame {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "a frame of {} bytes was rejected, expected {} bytes", self.bytes, self.expected)
    }
}

/// Keeps the first rejected frame.
#[derive(Debug, Clone, Default)]
pub(crate) struct FrameMeter {
    bytes: usize,
    expected: usize,
    first: Option<RejectedFrame>,
}

impl FrameMeter {
    pub(crate) fn record_request(&mut self, message: &Message) {
        self.expected = OVERHEAD
            + match message {
                Message::Hello => IDENTITY,
                Message::Configure(_) => CONFIGURED,
                _ => COMMAND,
            };
    }

    /// Call it for each part of the line up to the end of a frame. Delimiters before a frame do not
    /// belong to it.
    pub(crate) fn record_part(&mut self, part: &[u8]) {
        let delimiters = part.iter().take_while(|byte| self.bytes == 0 && **byte == 0).count();
        self.bytes += part.len() - delimiters;
    }

    pub(crate) fn end_frame(&mut self, is_rejected: bool) {
        let frame = RejectedFrame { bytes: std::mem::take(&mut self.bytes), expected: self.expected };
        if is_rejected {
            self.first.get_or_insert(frame);
        }
    }

    pub(crate) fn first(&self) -> Option<RejectedFrame> {
        self.first
    }

    /// Starts a trial.
    pub(crate) fn reset(&mut self) {
        self.first = None;
    }
}

/// The first rejected frame of an answer. `request` is the frame that it answers.
#[cfg(feature = "emulated")]
pub(crate) fn rejected_answer(request: &[u8], answer: &[u8]) -> Option<RejectedFrame> {
    let mut meter = FrameMeter::default();
    meter.record_request(&PacketReader::new().packets(request).flatten().last()?.message);
    let mut reader = PacketReader::new();
    for byte in answer {
        meter.record_part(std::slice::from_ref(byte));
        if let Some(frame) = reader.push(*byte) {
            meter.end_frame(frame.is_err());
        }
    }
    meter.first()
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::{Command, Configured, ControllerState, Gains, Packet, StateCause};

    fn length(message: Message) -> usize {
        Packet { sequence: 1, message }.encode().as_bytes().len()
    }

    #[test]
    fn expects_the_length_of_the_answer() {
        let command = Command {
            target_time_us: 1,
            drive_vpp: 1.0,
            frequency_mhz: 1,
            state: ControllerState::Running,
            cause: StateCause::None,
            flags: 0,
            compute_us: 1,
        };
        let gains = Gains { amplitude_kp: 1.0, amplitude_ki: 1.0, frequency_kp: 1.0, frequency_ki: 1.0 };
        assert_eq!(COMMAND + OVERHEAD, length(Message::Command(command)));
        assert_eq!(CONFIGURED + OVERHEAD, length(Message::Configured(Configured { outcome: Ok(gains) })));
        let mut meter = FrameMeter::default();
        meter.record_request(&Message::Safe);
        meter.record_part(&[0, 0, 3]);
        meter.record_part(&[1, 0]);
        meter.end_frame(true);
        meter.record_part(&[0, 1, 0]);
        meter.end_frame(true);
        assert_eq!(meter.first(), Some(RejectedFrame { bytes: 3, expected: 24 }));
    }

    #[cfg(feature = "emulated")]
    #[test]
    fn names_the_length_of_a_rejected_answer() {
        let frame = |message| Packet { sequence: 1, message }.encode().as_bytes().to_vec();
        let hello = frame(Message::Hello);
        assert_eq!(rejected_answer(&hello, &[]), None);
        assert_eq!(rejected_answer(&hello, &frame(Message::Safe)), None);
        let answer = [0, 4, 1, 2, 3, 0];
        let rejected = rejected_answer(&hello, &answer).unwrap();
        assert_eq!(rejected, RejectedFrame { bytes: 5, expected: IDENTITY + OVERHEAD });
    }
}
