//! Decodes packets from a stream of bytes.

use crate::field::MessageError;
use crate::frame::{FrameError, FrameReader};
use crate::packet::Packet;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketError {
    Frame(FrameError),
    /// The frame is intact, but its body is not a message of the protocol.
    Message(MessageError),
}

#[derive(Debug, Clone, Default)]
pub struct PacketReader(FrameReader);

impl PacketReader {
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes `bytes` up to the end of a frame and returns the packet or the error of this frame.
    /// Returns `None` if no frame ends within `bytes`.
    pub fn read(&mut self, bytes: &mut &[u8]) -> Option<Result<Packet, PacketError>> {
        let body = self.0.read(bytes)?.map_err(PacketError::Frame);
        Some(body.and_then(|body| Packet::decode(body).map_err(PacketError::Message)))
    }

    /// Does the same as [`PacketReader::read`] for one byte.
    pub fn push(&mut self, byte: u8) -> Option<Result<Packet, PacketError>> {
        self.read(&mut [byte].as_slice())
    }

    /// Yields the packet or the error of each frame that ends within `bytes`.
    pub fn packets<'a>(&'a mut self, mut bytes: &'a [u8]) -> impl Iterator<Item = Result<Packet, PacketError>> + 'a {
        core::iter::from_fn(move || self.read(&mut bytes))
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
