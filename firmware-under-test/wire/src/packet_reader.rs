//! Decodes packets from a stream of bytes.

use crate::field::MessageError;
use crate::frame::{FrameError, FrameReader};
use crate::packet::Packet;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketError {
    Frame(FrameError),
    /// The frame is intact, but its body is no message of the protocol.
    Message(MessageError),
}

/// Stores at most one frame.
#[derive(Debug, Clone, Default)]
pub struct PacketReader(FrameReader);

impl PacketReader {
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next byte of the stream. If it ends a frame, returns the frame's packet or error.
    pub fn push(&mut self, byte: u8) -> Option<Result<Packet, PacketError>> {
        let body = self.0.push(byte)?.map_err(PacketError::Frame);
        Some(body.and_then(|body| Packet::decode(body).map_err(PacketError::Message)))
    }

    /// Takes `bytes`. Yields the packet or the error of each frame that ends within them.
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
