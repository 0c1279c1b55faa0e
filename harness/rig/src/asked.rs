//! What is under way: the question on a line, and which answer ends it.

use platebench_wire::{FrameReader, Message, Packet};

/// Follows what is sent, to know whether an answer is due.
#[derive(Debug, Default)]
pub(crate) struct Asked {
    reader: FrameReader,
}

impl Asked {
    /// The number of the last whole message in `bytes` that asks for an answer.
    pub(crate) fn expects(&mut self, bytes: &[u8]) -> Option<u8> {
        let mut expected = None;
        for &byte in bytes {
            let Some(Ok(body)) = self.reader.push(byte) else { continue };
            if let Ok(Packet { sequence, message }) = Packet::decode(body) {
                let asks = matches!(
                    message,
                    Message::Hello | Message::Configure(_) | Message::Sample(_) | Message::Setpoint(_) | Message::Safe
                );
                expected = asks.then_some(sequence).or(expected);
            }
        }
        expected
    }
}

/// True where `body` is that of the answer to question `sequence`, or of the last thing that the target will say. Ticks and telemetry count by themselves.
pub(crate) fn answers(body: &[u8], sequence: u8) -> bool {
    match Packet::decode(body) {
        Ok(Packet { message: Message::Fault(_), .. }) => true,
        Ok(packet) => packet.sequence == sequence && !packet.message.counts_by_itself(),
        Err(_) => false,
    }
}
