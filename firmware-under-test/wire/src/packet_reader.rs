//! Decodes packets from a stream of bytes.

use crate::field::MessageError;
use crate::frame::{FrameError, FrameReader};
use crate::packet::Packet;

/// Why a frame holds no packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketError {
    /// The frame is damaged.
    Frame(FrameError),
    /// The frame is intact, but its body is no message of the protocol.
    Message(MessageError),
}

/// Splits a stream of bytes into frames and decodes each one; stores at most one frame.
#[derive(Debug, Clone, Default)]
pub struct PacketReader(FrameReader);

impl PacketReader {
    /// A reader at the start of a stream.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes one byte. Returns the packet of the frame that ends with it, or why that frame is rejected.
    pub fn push(&mut self, byte: u8) -> Option<Result<Packet, PacketError>> {
        let body = self.0.push(byte)?.map_err(PacketError::Frame);
        Some(body.and_then(|body| Packet::decode(body).map_err(PacketError::Message)))
    }

    /// Takes `bytes`. Yields the packet of each frame that ends within them, or why it is rejected.
    pub fn packets<'a>(&'a mut self, bytes: &'a [u8]) -> impl Iterator<Item = Result<Packet, PacketError>> + 'a {
        bytes.iter().filter_map(|&byte| self.push(byte))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packet::Message;
    use std::vec::Vec;

    #[test]
    fn rejects_a_damaged_frame_and_reads_the_next_one() {
        let packet = Packet { sequence: 7, message: Message::Hello };
        let frame = packet.encode();
        let mut damaged = frame.as_bytes().to_vec();
        damaged[1] ^= 1;
        let stream =
            [&damaged, frame.as_bytes(), crate::frame::EncodedFrame::new(&[0xff, 0]).unwrap().as_bytes()].concat();
        let mut reader = PacketReader::new();
        let (first, rest) = stream.split_at(damaged.len() + 3);
        assert_eq!(reader.packets(first).collect::<Vec<_>>(), [Err(PacketError::Frame(FrameError::Checksum))]);
        let rest: Vec<_> = reader.packets(rest).collect();
        assert!(matches!(rest[..], [Ok(read), Err(PacketError::Message(_))] if read == packet), "{rest:?}");
    }
}
