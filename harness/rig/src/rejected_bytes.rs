//! Describes bytes of the other side that are no valid frame.

use platebench_model::in_quotes;
use platebench_wire::{FrameError, PacketError};
use std::fmt;

/// Largest number of quoted characters of text that the other side sent.
const MAX_TEXT: usize = 80;
/// Shorter texts are as likely noise.
const MIN_TEXT: usize = 4;

/// Bytes before the identity that are no valid frame. Prints them as the second part of a sentence.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RejectedBytes {
    pub bytes: u64,
    pub frames: u32,
    pub last: Option<PacketError>,
    start: Vec<u8>,
}

impl RejectedBytes {
    pub(crate) fn keep_start(&mut self, byte: u8) {
        if self.start.len() <= MAX_TEXT {
            self.start.push(byte);
        }
    }

    /// The first bytes in quotes, if they are a text.
    pub(crate) fn text(&self) -> Option<String> {
        quoted_text(&self.start)
    }
}

/// Returns `bytes` in quotes if they are a printable text in ASCII, shortened to one line.
pub(crate) fn quoted_text(bytes: &[u8]) -> Option<String> {
    let text = str::from_utf8(bytes).ok()?.trim();
    let is_text = |letter: char| letter == ' ' || letter.is_ascii_graphic() || letter.is_ascii_whitespace();
    (text.len() >= MIN_TEXT && text.chars().all(is_text)).then(|| in_quotes(text, MAX_TEXT))
}

impl fmt::Display for RejectedBytes {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { bytes, frames, last, .. } = self;
        if *bytes == 0 {
            return formatter.write_str("; no byte was rejected");
        }
        write!(formatter, "; {bytes} bytes were rejected")?;
        if let Some(last) = last {
            let problem = match last {
                PacketError::Frame(FrameError::Checksum) => "a wrong CRC",
                PacketError::Frame(FrameError::InvalidCobs) => "invalid COBS",
                PacketError::Frame(FrameError::Overlong) => "no end within the length of a frame",
                PacketError::Frame(FrameError::Truncated) => "no room for a CRC",
                PacketError::Message(_) => "a message that the protocol does not have",
            };
            let noun = if *frames == 1 { "frame" } else { "frames" };
            write!(formatter, " in {frames} {noun}, the last one has {problem}")?;
        }
        self.text().map_or(Ok(()), |text| write!(formatter, "; they begin with {text}"))
    }
}
