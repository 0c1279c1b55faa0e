//! Stores messages in flight and cuts bytes into frames, without allocation.

use arrayvec::ArrayVec;
use platebench_wire::{MAX_ENCODED, Message, Packet, PacketReader};
use std::time::Duration;

/// Enough for a message with noise, or for a repeated message.
const MAX_PACKET_BYTES: usize = 4 * MAX_ENCODED;

#[derive(Debug, Clone)]
pub(super) struct QueuedPacket {
    pub(super) due: Duration,
    pub(super) bytes: ArrayVec<u8, MAX_PACKET_BYTES>,
}

impl QueuedPacket {
    /// `None` for no bytes, or more than [`MAX_PACKET_BYTES`].
    pub(super) fn new(due: Duration, content: &[u8]) -> Option<Self> {
        let bytes = ArrayVec::try_from(content).ok().filter(|bytes| !bytes.is_empty())?;
        Some(Self { due, bytes })
    }

    pub(super) fn flip(&mut self, bit: usize) {
        if let Some(byte) = self.bytes.get_mut(bit / 8) {
            *byte ^= 1 << (bit % 8);
        }
    }

    /// Changes nothing if there is not enough room.
    pub(super) fn prepend(&mut self, content: &[u8]) {
        let mut whole = ArrayVec::new();
        let added = whole.try_extend_from_slice(content).and_then(|()| whole.try_extend_from_slice(&self.bytes));
        if added.is_ok() {
            self.bytes = whole;
        }
    }

    pub(super) fn duplicate(&mut self) {
        let _ = self.bytes.try_extend_from_slice(&self.bytes.clone());
    }
}

#[derive(Debug, Default)]
pub(super) struct FrameSplitter {
    bytes: ArrayVec<u8, MAX_ENCODED>,
    complete: bool,
}

impl FrameSplitter {
    /// Returns the collected bytes if `byte` is the delimiter or fills the buffer.
    pub(super) fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if std::mem::take(&mut self.complete) {
            self.bytes.clear();
        }
        let _ = self.bytes.try_push(byte);
        self.complete = byte == 0 || self.bytes.is_full();
        self.complete.then_some(&self.bytes)
    }
}

pub(super) fn decode_first_packet(bytes: &[u8]) -> Option<Packet> {
    PacketReader::new().packets(bytes).next()?.ok()
}

pub(super) fn is_sample(bytes: &[u8]) -> bool {
    matches!(decode_first_packet(bytes), Some(Packet { message: Message::Sample(_), .. }))
}
