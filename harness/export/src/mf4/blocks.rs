//! The blocks of ASAM MDF 4.10, byte by byte, all numbers little-endian.
//!
//! A block is its kind, its length, its links and its data, and begins at a multiple of 8. A link is the place of another
//! block in the file, 0 where there is none; links to blocks that come later are written once those are there.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};

/// Bytes before a block's links: kind, reserved, length, number of links.
const HEAD: u64 = 24;
/// Bytes of a link.
const LINK: u64 = 8;
/// Where the header block is: after the identification.
const HEADER_AT: u64 = 64;

/// What a channel holds, and where in a record.
#[derive(Debug, Clone, Copy)]
pub(super) enum Kind {
    /// The time, s, as a double: the group's master.
    Time {
        /// Its first byte.
        byte: u32,
    },
    /// A double.
    Real {
        /// Its first byte.
        byte: u32,
    },
    /// One bit.
    Bit {
        /// Its byte.
        byte: u32,
        /// Counted from the least.
        bit: u8,
    },
}

/// A channel with the places of its texts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Channel {
    pub(super) name: u64,
    pub(super) unit: u64,
    pub(super) comment: u64,
    pub(super) kind: Kind,
}

/// A group that is being written.
pub(super) struct Group {
    channels: u64,
    data: u64,
    records: u64,
    record_bytes: u64,
}

/// A file of blocks.
pub(super) struct Blocks {
    file: BufWriter<File>,
    /// Where the next byte goes.
    at: u64,
    /// The link that the next data group is named by.
    next_group: u64,
}

impl Blocks {
    /// Begins a file.
    pub(super) fn start(file: File) -> io::Result<Self> {
        let mut blocks = Self { file: BufWriter::new(file), at: 0, next_group: HEADER_AT + HEAD };
        let mut identification = Vec::with_capacity(64);
        identification.extend(b"MDF     4.10    platebch");
        identification.extend([0; 4]);
        identification.extend(410_u16.to_le_bytes());
        identification.resize(64, 0);
        blocks.put(&identification)?;
        Ok(blocks)
    }

    /// The header and the file's history, which each have one comment in XML.
    pub(super) fn header(&mut self, started_ns: u64, comment: &str, history: &str) -> io::Result<()> {
        let mut time = Vec::with_capacity(16);
        time.extend(started_ns.to_le_bytes());
        // Minutes from UTC, of the zone and of daylight saving, both known.
        time.extend([0; 4]);
        time.push(0b10);
        let mut data = time.clone();
        data.extend([0; 3]);
        // Start angle and start distance, which the flags above say that there are none of.
        data.extend([0; 16]);
        let header = self.block(*b"HD", &[0; 6], &data)?;
        let comment = self.string(*b"MD", comment)?;
        self.link(header, 5, comment)?;
        let history = self.string(*b"MD", history)?;
        time.extend([0; 3]);
        let history = self.block(*b"FH", &[0, history], &time)?;
        self.link(header, 1, history)
    }

    /// A text, and where it is.
    pub(super) fn text(&mut self, text: &str) -> io::Result<u64> {
        self.string(*b"TX", text)
    }

    /// Begins a data group with one channel group, whose records follow.
    pub(super) fn group(
        &mut self,
        name: &str,
        comment: &str,
        channels: &[Channel],
        record_bytes: u32,
    ) -> io::Result<Group> {
        let (name, comment) = (self.text(name)?, self.text(comment)?);
        let mut first = 0;
        // From the last to the first, so that each knows the next.
        for channel in channels.iter().rev() {
            first = self.channel(*channel, first)?;
        }
        let mut data = vec![0; 24];
        data.extend(record_bytes.to_le_bytes());
        data.extend([0; 4]);
        let channel_group = self.block(*b"CG", &[0, first, name, 0, 0, comment], &data)?;
        let group = self.block(*b"DG", &[0, channel_group, 0, 0], &[0; 8])?;
        self.number_at(self.next_group, group)?;
        self.next_group = group + HEAD;
        let data = self.block(*b"DT", &[], &[])?;
        self.link(group, 2, data)?;
        Ok(Group { channels: channel_group, data, records: 0, record_bytes: record_bytes.into() })
    }

    fn channel(&mut self, channel: Channel, next: u64) -> io::Result<u64> {
        // Channel type 2 is a master, and of time where the synchronisation type is 1; data type 4 is a real, 0 unsigned.
        let ((channel_type, sync, data_type), byte, bit, bits) = match channel.kind {
            Kind::Time { byte } => ((2, 1, 4), byte, 0, 64_u32),
            Kind::Real { byte } => ((0, 0, 4), byte, 0, 64),
            Kind::Bit { byte, bit } => ((0, 0, 0), byte, bit, 1),
        };
        let mut data = vec![channel_type, sync, data_type, bit];
        data.extend(byte.to_le_bytes());
        data.extend(bits.to_le_bytes());
        // No flags: no invalidation bit, precision, attachments, ranges or limits.
        data.resize(72, 0);
        let Channel { name, unit, comment, .. } = channel;
        self.block(*b"CN", &[next, 0, name, 0, 0, 0, unit, comment], &data)
    }

    /// Appends a record to the group that was begun last.
    pub(super) fn record(&mut self, group: &mut Group, record: &[u8]) -> io::Result<()> {
        group.records += 1;
        self.put(record)
    }

    /// Ends the group that was begun last: only now is it known how long it is.
    pub(super) fn end_group(&mut self, group: &Group) -> io::Result<()> {
        self.number_at(group.data + LINK, HEAD + group.records * group.record_bytes)?;
        // The cycle count stands after the channel group's six links and its record identifier.
        self.number_at(group.channels + HEAD + 6 * LINK + 8, group.records)
    }

    /// Hands everything to the system.
    pub(super) fn finish(mut self) -> io::Result<()> {
        self.file.flush()
    }

    /// Text or XML, which ends in a zero.
    fn string(&mut self, kind: [u8; 2], text: &str) -> io::Result<u64> {
        // A zero would end it early.
        let mut data: Vec<u8> = text.bytes().filter(|byte| *byte != 0).collect();
        data.resize((data.len() / 8 + 1) * 8, 0);
        self.block(kind, &[], &data)
    }

    /// A block, and where it is.
    fn block(&mut self, kind: [u8; 2], links: &[u64], data: &[u8]) -> io::Result<u64> {
        let padding = self.at.next_multiple_of(8) - self.at;
        self.put([0; 8].get(..padding as usize).unwrap_or_default())?;
        let place = self.at;
        let mut block = b"##".to_vec();
        block.extend(kind);
        block.extend([0; 4]);
        block.extend((HEAD + links.len() as u64 * LINK + data.len() as u64).to_le_bytes());
        block.extend((links.len() as u64).to_le_bytes());
        block.extend(links.iter().flat_map(|link| link.to_le_bytes()));
        block.extend(data);
        self.put(&block)?;
        Ok(place)
    }

    /// Points the link of that number of the block at `place` to `target`.
    fn link(&mut self, place: u64, number: u64, target: u64) -> io::Result<()> {
        self.number_at(place + HEAD + number * LINK, target)
    }

    /// Writes a number into what is written already.
    fn number_at(&mut self, place: u64, number: u64) -> io::Result<()> {
        self.file.seek(SeekFrom::Start(place))?;
        self.file.write_all(&number.to_le_bytes())?;
        self.file.seek(SeekFrom::Start(self.at))?;
        Ok(())
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.at += bytes.len() as u64;
        Ok(())
    }
}
