//! Reads and writes the little-endian fields of a body.

use crate::frame::MAX_BODY;

/// Reason why a body with a correct checksum was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageError {
    Version(u8),
    Kind(u8),
    Length,
    Field,
}

pub(crate) trait Field: Sized {
    fn write(&self, writer: &mut Writer);
    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError>;
}

/// Implements [`Field`] for a structure: its fields in this order, without padding.
macro_rules! layout {
    ($type:ident { $($field:ident),+ $(,)? }) => {
        impl $crate::field::Field for $type {
            fn write(&self, writer: &mut $crate::field::Writer) {
                $(writer.write(&self.$field);)+
            }

            fn read(reader: &mut $crate::field::Reader<'_>) -> Result<Self, $crate::field::MessageError> {
                Ok(Self { $($field: reader.read()?),+ })
            }
        }
    };
}
pub(crate) use layout;

pub(crate) struct Writer {
    bytes: [u8; MAX_BODY],
    length: usize,
}

impl Writer {
    pub(crate) fn new() -> Self {
        Self { bytes: [0; MAX_BODY], length: 0 }
    }

    pub(crate) fn write(&mut self, field: &impl Field) {
        field.write(self);
    }

    pub(crate) fn body(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }
}

pub(crate) struct Reader<'a> {
    remaining: &'a [u8],
}

impl<'a> Reader<'a> {
    pub(crate) fn new(body: &'a [u8]) -> Self {
        Self { remaining: body }
    }

    /// Fails with [`MessageError::Length`] if the body ends within the field.
    pub(crate) fn read<T: Field>(&mut self) -> Result<T, MessageError> {
        T::read(self)
    }

    pub(crate) fn is_at_end(&self) -> bool {
        self.remaining.is_empty()
    }
}

impl<const N: usize> Field for [u8; N] {
    fn write(&self, writer: &mut Writer) {
        // Every message fits: the tests of `packet` encode each of them.
        if let Some(place) = writer.bytes.get_mut(writer.length..writer.length + N) {
            place.copy_from_slice(self);
            writer.length += N;
        }
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let (field, rest) = reader.remaining.split_first_chunk::<N>().ok_or(MessageError::Length)?;
        reader.remaining = rest;
        Ok(*field)
    }
}

macro_rules! number_fields {
    ($($type:ty)+) => {$(
        impl Field for $type {
            fn write(&self, writer: &mut Writer) {
                writer.write(&self.to_le_bytes());
            }

            fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
                reader.read().map(Self::from_le_bytes)
            }
        }
    )+};
}
number_fields!(u8 u16 u32 f32);
