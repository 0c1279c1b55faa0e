//! Collects what the firmware writes to channel 0 of RTT.

use super::memory::Memory;
use crate::symbols::Symbols;
use platebench_model::metrics::OutputRead;

const CONTROL_BLOCK: &str = "_SEGGER_RTT";
const IDENTIFIER: &[u8] = b"SEGGER RTT\0";
const CHANNEL_COUNT: u64 = 16;
const BUFFER: u64 = 28;
const SIZE: u64 = 32;
const WRITE_OFFSET: u64 = 36;
const READ_OFFSET: u64 = 40;
const FLAGS: u64 = 44;
const MODE: u32 = 0b11;
/// Mode in which the firmware waits for room instead of overwriting or dropping.
const BLOCK_IF_FULL: u32 = 2;
/// Longest text of a trial, bytes. The rest is dropped.
const MAX_BYTES: usize = 16 * 1024;

/// Collects the text that the firmware writes to channel 0 of RTT (SEGGER, *Real Time Transfer*). The
/// control block is the variable `_SEGGER_RTT`: an identifier of 16 bytes, the number of channels to
/// the bench (4 bytes), the number from the bench (4 bytes), and per channel 24 bytes: name, buffer,
/// size, write offset, read offset, flags.
#[derive(Debug, Clone, Default)]
pub(super) struct FirmwareOutput {
    control_block: Option<u64>,
    bytes: Vec<u8>,
    reads: Vec<Read>,
    last_read_ns: u64,
    is_cut: bool,
    /// True if the ELF has the table of the crate `defmt`, whose frames are no text. The firmware then
    /// overwrites unread bytes unless the host sets the blocking mode.
    has_frames: bool,
}

/// A part of the output that the bench read at once.
#[derive(Debug, Clone, Copy)]
struct Read {
    /// End of the part in the bytes of the output.
    end: usize,
    from_ns: u64,
    to_ns: u64,
}

impl FirmwareOutput {
    pub(super) fn new(elf: &[u8]) -> Self {
        let control_block = Symbols::variable(elf, CONTROL_BLOCK).map(|(address, _)| u64::from(address));
        Self { control_block, has_frames: Symbols::has_section(elf, ".defmt"), ..Self::default() }
    }

    pub(super) fn is_blocking(&self) -> bool {
        self.has_frames && self.control_block.is_some()
    }

    /// Discards the text. `now_ns` is the time of the chip.
    pub(super) fn start(&mut self, now_ns: u64) {
        self.bytes.clear();
        self.reads.clear();
        self.last_read_ns = now_ns;
        self.is_cut = false;
    }

    /// Empties the ring buffer, as a debug probe does. Returns true if it wrote to the memory.
    pub(super) fn drain(&mut self, memory: &mut Memory, now_ns: u64) -> bool {
        let Some(block) = self.control_block else { return false };
        let flags = memory.word(block + FLAGS).filter(|_| self.has_frames && is_initialised(memory, block));
        if let Some(flags) = flags.filter(|flags| flags & MODE != BLOCK_IF_FULL) {
            memory.store(block + FLAGS, &(flags & !MODE | BLOCK_IF_FULL).to_le_bytes());
        }
        let from_ns = std::mem::replace(&mut self.last_read_ns, now_ns);
        let Some((text, write_offset)) = read_ring(memory, block) else { return false };
        let room = MAX_BYTES - self.bytes.len();
        self.is_cut |= text.len() > room;
        self.bytes.extend(text.into_iter().take(room));
        if room > 0 {
            self.reads.push(Read { end: self.bytes.len(), from_ns, to_ns: now_ns });
        }
        memory.store(block + READ_OFFSET, &write_offset.to_le_bytes())
    }

    /// Also returns unread text, because a trap may end a trial before the bench drains it. `None`
    /// without text, and for frames.
    pub(super) fn text(&self, memory: &Memory) -> Option<String> {
        let bytes = self.all_bytes(memory);
        if self.has_frames {
            return None;
        }
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let end = if self.is_cut { "\n(cut after 16 KiB)" } else { "" };
        (!text.is_empty()).then(|| text + end)
    }

    fn all_bytes(&self, memory: &Memory) -> Vec<u8> {
        let rest = self.control_block.and_then(|block| read_ring(memory, block)).map(|(rest, _)| rest);
        let mut bytes = self.bytes.clone();
        bytes.extend(rest.into_iter().flatten().take(MAX_BYTES - self.bytes.len()));
        bytes
    }

    /// Frames of defmt. `None` if the firmware writes text, or nothing.
    pub(super) fn frames(&self, memory: &Memory) -> Option<Vec<u8>> {
        Some(self.all_bytes(memory)).filter(|bytes| self.has_frames && !bytes.is_empty())
    }

    /// The parts of [`Self::text`]. `seconds` converts the time of the chip. `None` if the firmware
    /// has no control block or writes frames.
    pub(super) fn reads(&self, memory: &Memory, now_ns: u64, seconds: impl Fn(u64) -> f64) -> Option<Vec<OutputRead>> {
        self.control_block.filter(|_| !self.has_frames)?;
        let bytes = self.all_bytes(memory);
        let rest = Read { end: bytes.len(), from_ns: self.last_read_ns, to_ns: now_ns };
        let rest = (bytes.len() > self.bytes.len()).then_some(rest);
        let (mut converted, mut end) = (0, 0);
        let reads = self.reads.iter().copied().chain(rest).map(|read| {
            let part = bytes.get(converted..read.end).unwrap_or_default();
            let part = part.get(..part.len() - incomplete_character(part)).unwrap_or_default();
            converted += part.len();
            end += String::from_utf8_lossy(part).len();
            OutputRead { end, from_s: seconds(read.from_ns), to_s: seconds(read.to_ns) }
        });
        Some(reads.collect())
    }

    /// Adds to the times of the present reads.
    pub(super) fn shift(&mut self, by_ns: u64) {
        for read in &mut self.reads {
            read.from_ns += by_ns;
            read.to_ns += by_ns;
        }
    }
}

/// Number of bytes at the end that begin a character of UTF-8 whose other bytes are missing.
fn incomplete_character(bytes: &[u8]) -> usize {
    let end = bytes.utf8_chunks().last().map_or(&[][..], |chunk| chunk.invalid());
    let is_incomplete = std::str::from_utf8(end).is_err_and(|error| error.error_len().is_none());
    if is_incomplete { end.len() } else { 0 }
}

/// RAM is undefined until the firmware has initialised the block.
fn is_initialised(memory: &Memory, block: u64) -> bool {
    memory.slice(block, IDENTIFIER.len()) == Some(IDENTIFIER) && memory.word(block + CHANNEL_COUNT).unwrap_or(0) > 0
}

/// Returns the unread text and its end as an offset in the buffer. `None` without text or with an
/// invalid control block.
fn read_ring(memory: &Memory, block: u64) -> Option<(Vec<u8>, u32)> {
    if !is_initialised(memory, block) {
        return None;
    }
    let [buffer, size, write_offset, read_offset] =
        [BUFFER, SIZE, WRITE_OFFSET, READ_OFFSET].map(|field| memory.word(block + field));
    let (buffer, size, write_offset, read_offset) = (buffer?, size?, write_offset?, read_offset?);
    if write_offset == read_offset || write_offset >= size || read_offset >= size {
        return None;
    }
    let part = |from: u32, to: u32| memory.slice(u64::from(buffer) + u64::from(from), (to - from) as usize);
    let text = if read_offset < write_offset {
        part(read_offset, write_offset)?.to_vec()
    } else {
        [part(read_offset, size)?, part(0, write_offset)?].concat()
    };
    Some((text, write_offset))
}
