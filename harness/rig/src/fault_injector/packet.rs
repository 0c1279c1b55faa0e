//! Stores messages in flight and cuts bytes into frames, without allocation.

use platebench_wire::{MAX_ENCODED, Message, Packet, PacketReader};
use std::time::Duration;

/// Holds a message with noise, or a message twice.
const MAX_PACKET_BYTES: usize = 4 * MAX_ENCODED;

#[derive(Debug, Clone)]
pub(super) struct QueuedPacket {
    pub(super) due: Duration,
    bytes: [u8; MAX_PACKET_BYTES],
    length: usize,
}

impl QueuedPacket {
    /// `None` for no bytes, or more than [`MAX_PACKET_BYTES`].
    pub(super) fn new(due: Duration, content: &[u8]) -> Option<Self> {
        let mut bytes = [0; MAX_PACKET_BYTES];
        bytes.get_mut(..content.len())?.copy_from_slice(content);
        (!content.is_empty()).then_some(Self { due, bytes, length: content.len() })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }

    pub(super) fn flip(&mut self, bit: usize) {
        if let Some(byte) = self.bytes.get_mut(bit / 8) {
            *byte ^= 1 << (bit % 8);
        }
    }

    pub(super) fn truncate(&mut self, length: usize) {
        self.length = self.length.min(length);
    }

    pub(super) fn prepend(&mut self, content: &[u8]) {
        let length = content.len() + self.length;
        if length <= MAX_PACKET_BYTES {
            self.bytes.copy_within(..self.length, content.len());
            if let Some(front) = self.bytes.get_mut(..content.len()) {
                front.copy_from_slice(content);
            }
            self.length = length;
        }
    }

    pub(super) fn duplicate(&mut self) {
        if 2 * self.length <= MAX_PACKET_BYTES {
            self.bytes.copy_within(..self.length, self.length);
            self.length *= 2;
        }
    }
}

#[derive(Debug)]
pub(super) struct FrameSplitter {
    bytes: [u8; MAX_ENCODED],
    length: usize,
    complete: bool,
}

impl Default for FrameSplitter {
    fn default() -> Self {
        Self { bytes: [0; MAX_ENCODED], length: 0, complete: false }
    }
}

impl FrameSplitter {
    /// Takes one byte. Returns the collected bytes at a delimiter, and when the buffer is full.
    pub(super) fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if std::mem::take(&mut self.complete) {
            self.length = 0;
        }
        if let Some(place) = self.bytes.get_mut(self.length) {
            *place = byte;
            self.length += 1;
        }
        self.complete = byte == 0 || self.length == self.bytes.len();
        if self.complete { self.bytes.get(..self.length) } else { None }
    }
}

pub(super) fn decode_first_packet(bytes: &[u8]) -> Option<Packet> {
    PacketReader::new().packets(bytes).next()?.ok()
}

pub(super) fn is_sample(bytes: &[u8]) -> bool {
    matches!(decode_first_packet(bytes), Some(Packet { message: Message::Sample(_), .. }))
}
