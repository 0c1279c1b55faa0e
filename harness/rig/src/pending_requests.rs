//! Finds the answer that ends an exchange.

use platebench_wire::{Message, Packet, PacketReader};

/// The request of an exchange and the answers to it.
#[derive(Debug, Default)]
pub(crate) struct PendingRequests {
    requests: PacketReader,
    answers: PacketReader,
    /// Number of the last request, if it asks for an answer.
    expected: Option<u8>,
}

impl PendingRequests {
    /// Takes the bytes to send. True if the last whole message in them asks for an answer.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> bool {
        self.expected = None;
        for packet in self.requests.packets(bytes).flatten() {
            let asks = matches!(
                packet.message,
                Message::Hello | Message::Configure(_) | Message::Sample(_) | Message::Setpoint(_) | Message::Safe
            );
            self.expected = asks.then_some(packet.sequence).or(self.expected);
        }
        self.expected.is_some()
    }

    /// Takes a received byte. True at the end of the awaited answer, and of a fault report, after which
    /// none comes. Ticks and telemetry have their own numbers.
    pub(crate) fn is_answered_by(&mut self, byte: u8) -> bool {
        match self.answers.push(byte) {
            Some(Ok(Packet { message: Message::Fault(_), .. })) => true,
            Some(Ok(packet)) => Some(packet.sequence) == self.expected && !packet.message.is_unsolicited(),
            _ => false,
        }
    }
}
