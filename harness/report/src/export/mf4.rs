//! Writes ASAM MDF 4.10: a file per trial, so that a channel name is unique in its file.
//!
//! The data group has one channel group, its channels and one data block. Flags are bits of one
//! byte. The library mdf4-rs 0.6 is not used: it needs a newer compiler and writes neither start
//! time nor history.
//!
//! Numbers are little-endian. A block has kind, length, links and data, and starts at a multiple of 8 bytes. A link is
//! the position of another block, or 0. Links to later blocks are written after these blocks.

use crate::export::source::{ExportError, ExportScenario, ExportTrial, FLAG_COLUMNS, NUMBER_COLUMNS};
use platebench_model::trace::AtPath;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

const RECORD_BYTES: usize = NUMBER_COLUMNS.len() * 8 + 1;

pub(crate) fn write(
    source: &ExportScenario<'_>,
    trial: &ExportTrial<'_>,
    file: &File,
    path: &Path,
) -> Result<(), ExportError> {
    let mut blocks = BlockWriter::start(file).at(path)?;
    let channels = write_header(source, &mut blocks).at(path)?;
    write_group(trial, &channels, &mut blocks, path)?;
    Ok(blocks.finish().at(path)?)
}

fn write_header(source: &ExportScenario<'_>, blocks: &mut BlockWriter<'_>) -> io::Result<Vec<Channel>> {
    let facts = source.metadata();
    let mut properties = String::new();
    for (name, value) in &facts {
        let _ = write!(properties, "<e name=\"{name}\">{}</e>", escape_xml(value));
    }
    let title = escape_xml(&source.scenario.title);
    let comment = format!(
        "<HDcomment xmlns=\"http://www.asam.net/mdf/v4\"><TX>{title}</TX>\
         <common_properties>{properties}</common_properties></HDcomment>"
    );
    let tool = &source.run.tool;
    let history = format!(
        "<FHcomment xmlns=\"http://www.asam.net/mdf/v4\"><TX>exported from a run folder</TX>\
         <tool_id>{0}</tool_id><tool_vendor>{0}</tool_vendor><tool_version>{1}</tool_version></FHcomment>",
        escape_xml(&tool.name),
        escape_xml(&tool.version)
    );
    blocks.write_header(source.started_ns, &comment, &history)?;
    let mut channels = Vec::with_capacity(NUMBER_COLUMNS.len() + FLAG_COLUMNS.len());
    for (place, number) in NUMBER_COLUMNS.iter().enumerate() {
        let byte = (place * 8) as u32;
        channels.push(Channel {
            name: blocks.write_text(number.name())?,
            unit: blocks.write_text(number.unit)?,
            comment: blocks.write_text(number.meaning)?,
            kind: if place == 0 {
                ChannelKind::Time { byte }
            } else {
                ChannelKind::Real { byte, is_held: number.is_held() }
            },
        });
    }
    for (flag, bit) in FLAG_COLUMNS.iter().zip(0..) {
        channels.push(Channel {
            name: blocks.write_text(flag.name)?,
            unit: 0,
            comment: blocks.write_text(flag.meaning)?,
            kind: ChannelKind::Bit { byte: (NUMBER_COLUMNS.len() * 8) as u32, bit },
        });
    }
    Ok(channels)
}

fn write_group(
    trial: &ExportTrial<'_>,
    channels: &[Channel],
    blocks: &mut BlockWriter<'_>,
    path: &Path,
) -> Result<(), ExportError> {
    let name = format!("trial {:03}", trial.index);
    let comment = format!("seed {}", trial.seed);
    let mut group = blocks.start_group(&name, &comment, channels, RECORD_BYTES as u32).at(path)?;
    for row in trial.rows()? {
        let row = row?;
        let mut record = [0; RECORD_BYTES];
        let (numbers, flags) = record.split_at_mut(NUMBER_COLUMNS.len() * 8);
        for (place, number) in numbers.chunks_exact_mut(8).zip(NUMBER_COLUMNS) {
            place.copy_from_slice(&number.column.value(&row).to_le_bytes());
        }
        for (flag, bit) in FLAG_COLUMNS.iter().zip(0_u8..) {
            if let Some(byte) = flags.first_mut() {
                *byte |= u8::from(row.flags.contains(flag.flag)) << bit;
            }
        }
        blocks.write_record(&mut group, &record).at(path)?;
    }
    Ok(blocks.end_group(&group).at(path)?)
}

/// Omits characters that XML 1.0 forbids.
fn escape_xml(text: &str) -> String {
    let is_forbidden = |letter| (letter < ' ' && !"\t\n\r".contains(letter)) || "\u{fffe}\u{ffff}".contains(letter);
    let escaped = text.replace(is_forbidden, "").replace('&', "&amp;");
    escaped.replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Size of the header fields: kind, reserved bytes, length, number of links.
const BLOCK_HEADER_BYTES: u64 = 24;
const LINK_BYTES: u64 = 8;
/// Flag of a channel: readers must not interpolate it.
const DISCRETE_VALUE: u32 = 1 << 8;
/// The header block follows the identification block of 64 bytes.
const HEADER_POSITION: u64 = 64;

#[derive(Debug, Clone, Copy)]
enum ChannelKind {
    /// The master channel: time, s, as a double.
    Time { byte: u32 },
    Real {
        byte: u32,
        /// True if the value holds until the next record.
        is_held: bool,
    },
    Bit {
        byte: u32,
        /// 0 is the least significant bit.
        bit: u8,
    },
}

/// Name, unit and comment are positions of text blocks, or 0 if the channel has none.
#[derive(Debug, Clone, Copy)]
struct Channel {
    name: u64,
    unit: u64,
    comment: u64,
    kind: ChannelKind,
}

struct ChannelGroup {
    channels: u64,
    data: u64,
    records: u64,
    record_bytes: u64,
}

struct BlockWriter<'a> {
    file: BufWriter<&'a File>,
    position: u64,
}

impl<'a> BlockWriter<'a> {
    fn start(file: &'a File) -> io::Result<Self> {
        let mut blocks = Self { file: BufWriter::new(file), position: 0 };
        let mut identification = Vec::with_capacity(64);
        identification.extend(b"MDF     4.10    platebch");
        identification.extend([0; 4]);
        identification.extend(410_u16.to_le_bytes());
        identification.resize(64, 0);
        blocks.write_bytes(&identification)?;
        Ok(blocks)
    }

    /// `comment` and `history` are XML.
    fn write_header(&mut self, started_ns: u64, comment: &str, history: &str) -> io::Result<()> {
        let mut time = Vec::with_capacity(16);
        time.extend(started_ns.to_le_bytes());
        // Offsets of time zone and daylight saving, min: 0. The next byte marks them as valid.
        time.extend([0; 4]);
        time.push(0b10);
        let mut data = time.clone();
        data.extend([0; 3]);
        // Start angle and start distance. The header flags before them are 0, so both are absent.
        data.extend([0; 16]);
        let header = self.write_block(*b"HD", &[0; 6], &data)?;
        let comment = self.write_string(*b"MD", comment)?;
        self.set_link(header, 5, comment)?;
        let history = self.write_string(*b"MD", history)?;
        time.extend([0; 3]);
        let history = self.write_block(*b"FH", &[0, history], &time)?;
        self.set_link(header, 1, history)
    }

    fn write_text(&mut self, text: &str) -> io::Result<u64> {
        self.write_string(*b"TX", text)
    }

    /// Starts the only group of the file. Its records must follow.
    fn start_group(
        &mut self,
        name: &str,
        comment: &str,
        channels: &[Channel],
        record_bytes: u32,
    ) -> io::Result<ChannelGroup> {
        let (name, comment) = (self.write_text(name)?, self.write_text(comment)?);
        let mut first = 0;
        for channel in channels.iter().rev() {
            first = self.write_channel(*channel, first)?;
        }
        let mut data = vec![0; 24];
        data.extend(record_bytes.to_le_bytes());
        data.extend([0; 4]);
        let channel_group = self.write_block(*b"CG", &[0, first, name, 0, 0, comment], &data)?;
        let group = self.write_block(*b"DG", &[0, channel_group, 0, 0], &[0; 8])?;
        self.set_link(HEADER_POSITION, 0, group)?;
        let data = self.write_block(*b"DT", &[], &[])?;
        self.set_link(group, 2, data)?;
        Ok(ChannelGroup { channels: channel_group, data, records: 0, record_bytes: record_bytes.into() })
    }

    fn write_channel(&mut self, channel: Channel, next: u64) -> io::Result<u64> {
        // Channel type 2: master. Synchronisation type 1: time. Data types 4: real, 0: unsigned.
        let ((channel_type, sync, data_type), byte, bit, bits, is_held) = match channel.kind {
            ChannelKind::Time { byte } => ((2, 1, 4), byte, 0, 64_u32, false),
            ChannelKind::Real { byte, is_held } => ((0, 0, 4), byte, 0, 64, is_held),
            ChannelKind::Bit { byte, bit } => ((0, 0, 0), byte, bit, 1, true),
        };
        let mut data = vec![channel_type, sync, data_type, bit];
        data.extend(byte.to_le_bytes());
        data.extend(bits.to_le_bytes());
        // No invalidation bit, precision, attachments, ranges or limits.
        data.extend(if is_held { DISCRETE_VALUE } else { 0 }.to_le_bytes());
        data.resize(72, 0);
        let Channel { name, unit, comment, .. } = channel;
        self.write_block(*b"CN", &[next, 0, name, 0, 0, 0, unit, comment], &data)
    }

    fn write_record(&mut self, group: &mut ChannelGroup, record: &[u8]) -> io::Result<()> {
        group.records += 1;
        self.write_bytes(record)
    }

    fn end_group(&mut self, group: &ChannelGroup) -> io::Result<()> {
        self.write_number_at(group.data + LINK_BYTES, BLOCK_HEADER_BYTES + group.records * group.record_bytes)?;
        // The cycle count (number of records) follows six links and the record identifier.
        self.write_number_at(group.channels + BLOCK_HEADER_BYTES + 6 * LINK_BYTES + 8, group.records)
    }

    fn finish(mut self) -> io::Result<()> {
        self.file.flush()
    }

    /// Writes text or XML with a terminating zero.
    fn write_string(&mut self, kind: [u8; 2], text: &str) -> io::Result<u64> {
        let mut data: Vec<u8> = text.bytes().filter(|byte| *byte != 0).collect();
        data.resize((data.len() / 8 + 1) * 8, 0);
        self.write_block(kind, &[], &data)
    }

    fn write_block(&mut self, kind: [u8; 2], links: &[u64], data: &[u8]) -> io::Result<u64> {
        let padding = self.position.next_multiple_of(8) - self.position;
        self.write_bytes([0; 8].get(..padding as usize).unwrap_or_default())?;
        let place = self.position;
        let mut block = b"##".to_vec();
        block.extend(kind);
        block.extend([0; 4]);
        block.extend((BLOCK_HEADER_BYTES + links.len() as u64 * LINK_BYTES + data.len() as u64).to_le_bytes());
        block.extend((links.len() as u64).to_le_bytes());
        block.extend(links.iter().flat_map(|link| link.to_le_bytes()));
        block.extend(data);
        self.write_bytes(&block)?;
        Ok(place)
    }

    fn set_link(&mut self, place: u64, number: u64, target: u64) -> io::Result<()> {
        self.write_number_at(place + BLOCK_HEADER_BYTES + number * LINK_BYTES, target)
    }

    fn write_number_at(&mut self, place: u64, number: u64) -> io::Result<()> {
        self.file.seek(SeekFrom::Start(place))?;
        self.file.write_all(&number.to_le_bytes())?;
        self.file.seek(SeekFrom::Start(self.position))?;
        Ok(())
    }

    fn write_bytes(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.position += bytes.len() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_markup() {
        assert_eq!(escape_xml("a < b & \"c\" > d\u{0}\u{1b}\tµ"), "a &lt; b &amp; &quot;c&quot; &gt; d\tµ");
    }
}
