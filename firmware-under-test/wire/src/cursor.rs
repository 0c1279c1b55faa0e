//! Little-endian reading and writing over a fixed body; both refuse to leave it.

use crate::frame::MAX_BODY;

/// Writes fields one after the other into a body of at most [`MAX_BODY`] bytes.
pub(crate) struct Writer {
    bytes: [u8; MAX_BODY],
    length: usize,
}

impl Writer {
    pub(crate) fn new() -> Self {
        Self { bytes: [0; MAX_BODY], length: 0 }
    }

    pub(crate) fn put<const N: usize>(&mut self, field: [u8; N]) {
        // Every message is shorter than MAX_BODY: `message::tests::no_message_outgrows_the_body` holds it.
        if let Some(place) = self.bytes.get_mut(self.length..self.length + N) {
            place.copy_from_slice(&field);
            self.length += N;
        }
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.put([value]);
    }

    pub(crate) fn u16(&mut self, value: u16) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn f32(&mut self, value: f32) {
        self.put(value.to_le_bytes());
    }

    pub(crate) fn body(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }
}

/// Reads fields one after the other; `None` at the first one that is not all there.
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    pub(crate) fn new(body: &'a [u8]) -> Self {
        Self { rest: body }
    }

    pub(crate) fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (field, rest) = self.rest.split_first_chunk::<N>()?;
        self.rest = rest;
        Some(*field)
    }

    pub(crate) fn u8(&mut self) -> Option<u8> {
        self.take::<1>().map(|[byte]| byte)
    }

    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    pub(crate) fn f32(&mut self) -> Option<f32> {
        self.take().map(f32::from_le_bytes)
    }

    /// True when the body held exactly what was read.
    pub(crate) fn is_at_end(&self) -> bool {
        self.rest.is_empty()
    }
}
