//! Frames a body as `COBS(body ‖ CRC-32(body)) ‖ 0x00` and reads frames of this form.
//!
//! COBS replaces every zero in the frame and adds one byte. A zero on the line therefore always
//! ends a frame. A reader that starts in the middle of a frame is synchronised after the next zero.
//! The CRC is CRC-32/ISO-HDLC (Ethernet, zlib), little-endian, over the body alone.

use crc::{CRC_32_ISO_HDLC, Crc, Table};

/// Largest length of a body in bytes, without the CRC.
pub const MAX_BODY: usize = 64;
/// Largest length of a frame: body, CRC, one COBS byte, delimiter.
pub const MAX_ENCODED: usize = MAX_BODY + CRC_BYTES + 2;

const CRC_BYTES: usize = 4;
/// CRC tables: one of 1 KiB on a board; with 16 tables, a PC processes 16 bytes at once.
const TABLES: usize = if cfg!(target_os = "none") { 1 } else { 16 };
static CHECKSUM: Crc<u32, Table<TABLES>> = Crc::<u32, Table<TABLES>>::new(&CRC_32_ISO_HDLC);

/// A frame with an error has no usable content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameError {
    InvalidCobs,
    /// More than [`MAX_ENCODED`] bytes without a delimiter.
    Overlong,
    Truncated,
    Checksum,
}

#[derive(Debug, Clone, Copy)]
pub struct EncodedFrame {
    bytes: [u8; MAX_ENCODED],
    length: usize,
}

impl EncodedFrame {
    /// `None` if `body` is longer than [`MAX_BODY`].
    pub fn new(body: &[u8]) -> Option<Self> {
        let mut bytes = [0; MAX_ENCODED];
        let end = 1 + body.len();
        let last = end + CRC_BYTES;
        // The last byte is the delimiter and is already zero.
        let frame = bytes.get_mut(..MAX_ENCODED - 1)?.get_mut(..last)?;
        frame.get_mut(1..end)?.copy_from_slice(body);
        frame.get_mut(end..)?.copy_from_slice(&CHECKSUM.checksum(body).to_le_bytes());
        stuff(frame);
        Some(Self { bytes, length: last + 1 })
    }

    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }
}

#[derive(Debug, Clone)]
pub struct FrameReader {
    buffer: [u8; MAX_ENCODED],
    length: usize,
    overlong: bool,
}

impl Default for FrameReader {
    fn default() -> Self {
        Self::new()
    }
}

impl FrameReader {
    pub fn new() -> Self {
        Self { buffer: [0; MAX_ENCODED], length: 0, overlong: false }
    }

    /// Takes `bytes` up to the end of the first frame and returns the body or the error of this
    /// frame. Returns `None` if no frame ends within `bytes`.
    pub fn read(&mut self, bytes: &mut &[u8]) -> Option<Result<&[u8], FrameError>> {
        loop {
            let Some(delimiter) = bytes.iter().position(|&byte| byte == 0) else {
                self.append(core::mem::take(bytes));
                return None;
            };
            let (frame, rest) = bytes.split_at(delimiter);
            *bytes = rest.get(1..).unwrap_or_default();
            self.append(frame);
            if self.length > 0 || self.overlong {
                return Some(self.end_frame());
            }
        }
    }

    /// Does the same as [`FrameReader::read`] for one byte.
    pub fn push(&mut self, byte: u8) -> Option<Result<&[u8], FrameError>> {
        self.read(&mut [byte].as_slice())
    }

    fn append(&mut self, bytes: &[u8]) {
        match self.buffer.get_mut(self.length..self.length + bytes.len()) {
            Some(place) => {
                place.copy_from_slice(bytes);
                self.length += bytes.len();
            }
            None => self.overlong = true,
        }
    }

    fn end_frame(&mut self) -> Result<&[u8], FrameError> {
        let length = core::mem::take(&mut self.length);
        if core::mem::take(&mut self.overlong) {
            return Err(FrameError::Overlong);
        }
        self.decode_frame(length)
    }

    fn decode_frame(&mut self, length: usize) -> Result<&[u8], FrameError> {
        let frame = self.buffer.get_mut(..length).ok_or(FrameError::Overlong)?;
        unstuff(frame)?;
        let unstuffed = frame.get(1..).unwrap_or_default();
        let (body, sent) = unstuffed.split_last_chunk::<CRC_BYTES>().ok_or(FrameError::Truncated)?;
        if u32::from_le_bytes(*sent) == CHECKSUM.checksum(body) { Ok(body) } else { Err(FrameError::Checksum) }
    }
}

/// Applies COBS in place; the first byte of `frame` must be zero. Each zero becomes the distance to
/// the next zero or to the end. [`MAX_ENCODED`] is below 255, so a distance always fits in a byte.
fn stuff(frame: &mut [u8]) {
    let mut next = frame.len();
    for (index, byte) in frame.iter_mut().enumerate().rev() {
        if *byte == 0 {
            *byte = (next - index) as u8;
            next = index;
        }
    }
}

/// Inverts [`stuff`]; `frame` contains no zero.
fn unstuff(frame: &mut [u8]) -> Result<(), FrameError> {
    let mut next = 0;
    while let Some(byte) = frame.get_mut(next) {
        next += usize::from(core::mem::take(byte));
    }
    if next == frame.len() { Ok(()) } else { Err(FrameError::InvalidCobs) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn read_all(bytes: &[u8]) -> Vec<Result<Vec<u8>, FrameError>> {
        let mut reader = FrameReader::new();
        bytes.iter().filter_map(|&byte| reader.push(byte).map(|frame| frame.map(<[u8]>::to_vec))).collect()
    }

    #[test]
    fn an_overlong_frame_in_one_slice_is_rejected_and_the_next_one_is_read() {
        let mut bytes = std::vec![1; MAX_ENCODED + 1];
        bytes.push(0);
        let body = [7; 3];
        bytes.extend_from_slice(EncodedFrame::new(&body).unwrap().as_bytes());
        let (mut reader, mut rest) = (FrameReader::new(), bytes.as_slice());
        assert_eq!(reader.read(&mut rest).map(|frame| frame.map(<[u8]>::to_vec)), Some(Err(FrameError::Overlong)));
        assert_eq!(reader.read(&mut rest).map(|frame| frame.map(<[u8]>::to_vec)), Some(Ok(body.to_vec())));
    }

    #[test]
    fn crc_32_has_the_published_check_value() {
        assert_eq!(CHECKSUM.checksum(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn a_frame_is_body_and_checksum_stuffed_and_a_zero() {
        let frame = EncodedFrame::new(&[0x11, 0x00, 0x2a]).unwrap();
        assert_eq!(frame.as_bytes(), [0x02, 0x11, 0x06, 0x2a, 0x83, 0xd9, 0x1e, 0x39, 0x00]);
    }

    #[test]
    fn rejects_a_body_of_one_byte_too_many() {
        let body = [7; MAX_BODY];
        let frame = EncodedFrame::new(&body).unwrap();
        assert_eq!(frame.as_bytes().len(), MAX_ENCODED);
        assert_eq!(read_all(frame.as_bytes()), [Ok(body.to_vec())]);
        assert!(EncodedFrame::new(&[7; MAX_BODY + 1]).is_none());
    }

    #[test]
    fn an_overlong_frame_is_one_error_and_the_next_is_read() {
        let mut bytes = std::vec![0x55; 10_000];
        bytes.push(0);
        bytes.extend_from_slice(EncodedFrame::new(&[1, 2, 3]).unwrap().as_bytes());
        assert_eq!(read_all(&bytes), [Err(FrameError::Overlong), Ok(std::vec![1, 2, 3])]);
    }

    #[test]
    fn a_frame_without_room_for_a_checksum_is_truncated() {
        assert_eq!(read_all(&[0x04, 1, 2, 3, 0]), [Err(FrameError::Truncated)]);
        assert_eq!(read_all(&[0, 0, 0]), []);
    }

    proptest! {
        #[test]
        fn stuffs_as_the_published_algorithm(body in proptest::collection::vec(0_u8..3, 0..=MAX_BODY)) {
            let mut stuffed = std::vec![0; 1];
            stuffed.extend_from_slice(&body);
            stuff(&mut stuffed);
            prop_assert_eq!(&stuffed, &cobs::encode_vec(&body));
            unstuff(&mut stuffed).unwrap();
            prop_assert_eq!(&stuffed[1..], body);
        }

        #[test]
        fn unstuffs_what_the_published_algorithm_does(frame in proptest::collection::vec(1_u8..9, 1..40)) {
            let mut unstuffed = frame.clone();
            let result = unstuff(&mut unstuffed).ok().map(|()| unstuffed[1..].to_vec());
            prop_assert_eq!(result, cobs::decode_vec(&frame).ok());
        }

        #[test]
        fn any_split_of_the_stream_gives_the_same_frames(
            bytes in proptest::collection::vec(0_u8..4, 0..300),
            split in 1_usize..100,
        ) {
            let mut reader = FrameReader::new();
            let mut frames = Vec::new();
            for mut chunk in bytes.chunks(split) {
                while let Some(frame) = reader.read(&mut chunk) {
                    frames.push(frame.map(<[u8]>::to_vec));
                }
            }
            prop_assert_eq!(frames, read_all(&bytes));
        }

        #[test]
        fn any_body_round_trips(body in proptest::collection::vec(any::<u8>(), 0..=MAX_BODY)) {
            let frame = EncodedFrame::new(&body).unwrap();
            prop_assert!(frame.as_bytes()[..frame.as_bytes().len() - 1].iter().all(|&byte| byte != 0));
            prop_assert_eq!(read_all(frame.as_bytes()), [Ok(body)]);
        }

        #[test]
        fn rejects_any_single_bit_flip(body in proptest::collection::vec(any::<u8>(), 2..=MAX_BODY)) {
            let frame = EncodedFrame::new(&body).unwrap();
            for bit in 0..frame.as_bytes().len() * 8 {
                let mut flipped = frame.as_bytes().to_vec();
                flipped[bit / 8] ^= 1 << (bit % 8);
                // Without its delimiter the frame joins the next one, which must not be accepted
                // either.
                flipped.extend_from_slice(frame.as_bytes());
                let bodies: Vec<_> = read_all(&flipped).into_iter().filter_map(Result::ok).collect();
                let flip_in_delimiter = bit / 8 == frame.as_bytes().len() - 1;
                let expected = if flip_in_delimiter { Vec::new() } else { std::vec![body.clone()] };
                prop_assert_eq!(bodies, expected, "bit {}", bit);
            }
        }

        #[test]
        fn garbage_gives_at_most_a_frame_per_delimiter(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
            prop_assert!(read_all(&bytes).len() < bytes.split(|&byte| byte == 0).count());
        }
    }
}
