//! Bytes on their way, and bytes cut into frames; both without allocation.

use platebench_wire::MAX_ENCODED;
use std::time::Duration;

/// A message with what the line made of it: room for noise and for being doubled.
const MOST_BYTES: usize = 4 * MAX_ENCODED;

/// Bytes that arrive together.
#[derive(Debug, Clone)]
pub(super) struct Parcel {
    /// When.
    pub(super) due: Duration,
    bytes: [u8; MOST_BYTES],
    length: usize,
}

impl Parcel {
    /// `None` where there are none, or more than a frame can get.
    pub(super) fn new(due: Duration, content: &[u8]) -> Option<Self> {
        let mut bytes = [0; MOST_BYTES];
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

    /// Puts `content` in front; nothing happens where it does not fit.
    pub(super) fn prepend(&mut self, content: &[u8]) {
        let length = content.len() + self.length;
        if length <= MOST_BYTES {
            self.bytes.copy_within(..self.length, content.len());
            if let Some(front) = self.bytes.get_mut(..content.len()) {
                front.copy_from_slice(content);
            }
            self.length = length;
        }
    }

    /// Twice the same; nothing happens where that does not fit.
    pub(super) fn double(&mut self) {
        if 2 * self.length <= MOST_BYTES {
            self.bytes.copy_within(..self.length, self.length);
            self.length *= 2;
        }
    }
}

/// Cuts what comes from the controller into frames, delimiter included, whatever is in them.
#[derive(Debug)]
pub(super) struct Frames {
    bytes: [u8; MAX_ENCODED],
    length: usize,
    whole: bool,
}

impl Default for Frames {
    fn default() -> Self {
        Self { bytes: [0; MAX_ENCODED], length: 0, whole: false }
    }
}

impl Frames {
    /// Takes one byte; gives the bytes up to here where a frame ends, or where there is no room for a longer one.
    pub(super) fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if std::mem::take(&mut self.whole) {
            self.length = 0;
        }
        if let Some(place) = self.bytes.get_mut(self.length) {
            *place = byte;
            self.length += 1;
        }
        self.whole = byte == 0 || self.length == self.bytes.len();
        if self.whole { self.bytes.get(..self.length) } else { None }
    }
}
