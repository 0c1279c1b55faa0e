//! MDF4: a measurement for each scenario, with a data group for each trial.
//!
//! ASAM MDF 4.10, the part of it that a table of numbers needs: identification, header, file history, and per trial a data
//! group with one channel group, its channels and one data block. Time is the master channel. A channel without a
//! conversion is 1:1. Flags are channels of one bit in a byte that they share. Written here because the library that writes
//! the format, mdf4-rs 0.6, asks for a newer compiler than this workspace and writes neither the start time nor the history.
//!
//! Neighbours: [`blocks`] knows the bytes of each block; here is what they say.

mod blocks;

use crate::columns::{FLAG_COLUMNS, NUMBER_COLUMNS};
use crate::error::ExportError;
use crate::source::{ExportScenario, ExportTrial};
use blocks::{BlockWriter, Channel, ChannelKind};
use std::fmt::Write as _;
use std::fs::File;
use std::io;
use std::path::Path;

/// Bytes of a record: the numbers, and one for the flags.
const RECORD_BYTES: usize = NUMBER_COLUMNS.len() * 8 + 1;

/// Writes the scenario's measurement.
pub(crate) fn write(source: &ExportScenario<'_>, file: File, path: &Path) -> Result<(), ExportError> {
    let mut blocks = BlockWriter::start(file).map_err(ExportError::io(path))?;
    let signals = write_header(source, &mut blocks).map_err(ExportError::io(path))?;
    for trial in &source.trials {
        write_group(trial, &signals, &mut blocks, path)?;
    }
    blocks.finish().map_err(ExportError::io(path))
}

/// A channel's texts, which all groups share.
struct ChannelTemplate {
    name: u64,
    unit: u64,
    meaning: u64,
    kind: ChannelKind,
}

/// Everything before the first data group.
fn write_header(source: &ExportScenario<'_>, blocks: &mut BlockWriter) -> io::Result<Vec<ChannelTemplate>> {
    let facts = source.metadata();
    let mut properties = String::new();
    for (name, value) in &facts {
        // Writing into a string does not fail.
        let _ = write!(properties, "<e name=\"{name}\">{}</e>", escape_xml(value));
    }
    let title = escape_xml(&source.scenario.title);
    let comment = format!(
        "<HDcomment xmlns=\"http://www.asam.net/mdf/v4\"><TX>{title}</TX><common_properties>{properties}</common_properties></HDcomment>"
    );
    let tool = &source.run.tool;
    let history = format!(
        "<FHcomment xmlns=\"http://www.asam.net/mdf/v4\"><TX>exported from a run folder</TX><tool_id>{0}</tool_id><tool_vendor>{0}</tool_vendor>\
         <tool_version>{1}</tool_version></FHcomment>",
        escape_xml(&tool.name),
        escape_xml(&tool.version)
    );
    blocks.write_header(source.started_ns, &comment, &history)?;
    let mut signals = Vec::with_capacity(NUMBER_COLUMNS.len() + FLAG_COLUMNS.len());
    for (place, number) in NUMBER_COLUMNS.iter().enumerate() {
        let byte = (place * 8) as u32;
        signals.push(ChannelTemplate {
            name: blocks.write_text(number.name)?,
            unit: blocks.write_text(number.unit)?,
            meaning: blocks.write_text(number.meaning)?,
            kind: if place == 0 { ChannelKind::Time { byte } } else { ChannelKind::Real { byte } },
        });
    }
    for (mark, bit) in FLAG_COLUMNS.iter().zip(0..) {
        signals.push(ChannelTemplate {
            name: blocks.write_text(mark.name)?,
            unit: 0,
            meaning: blocks.write_text(mark.meaning)?,
            kind: ChannelKind::Bit { byte: (NUMBER_COLUMNS.len() * 8) as u32, bit },
        });
    }
    Ok(signals)
}

/// One trial.
fn write_group(
    trial: &ExportTrial,
    signals: &[ChannelTemplate],
    blocks: &mut BlockWriter,
    path: &Path,
) -> Result<(), ExportError> {
    let name = format!("trial {:03}", trial.index);
    let comment = format!("seed {}", trial.seed);
    let channels: Vec<Channel> = signals
        .iter()
        .map(|ChannelTemplate { name, unit, meaning, kind }| Channel {
            name: *name,
            unit: *unit,
            comment: *meaning,
            kind: *kind,
        })
        .collect();
    let mut group =
        blocks.start_group(&name, &comment, &channels, RECORD_BYTES as u32).map_err(ExportError::io(path))?;
    for row in trial.rows()? {
        let row = row?;
        let mut record = [0; RECORD_BYTES];
        let (numbers, marks) = record.split_at_mut(NUMBER_COLUMNS.len() * 8);
        for (place, number) in numbers.chunks_exact_mut(8).zip(NUMBER_COLUMNS) {
            place.copy_from_slice(&(number.of)(&row).to_le_bytes());
        }
        for (mark, bit) in FLAG_COLUMNS.iter().zip(0_u8..) {
            if let Some(byte) = marks.first_mut() {
                *byte |= u8::from(row.flags.contains(mark.flag)) << bit;
            }
        }
        blocks.write_record(&mut group, &record).map_err(ExportError::io(path))?;
    }
    blocks.end_group(&group).map_err(ExportError::io(path))
}

/// Text as XML holds it; what XML 1.0 has no character for is left out.
fn escape_xml(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '&' => escaped.push_str("&amp;"),
            '"' => escaped.push_str("&quot;"),
            '\t' | '\n' | '\r' => escaped.push(character),
            '\u{fffe}' | '\u{ffff}' => {}
            other if other < ' ' => {}
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markup_in_titles_is_text() {
        assert_eq!(escape_xml("a < b & \"c\" > d\u{0}\u{1b}\tµ"), "a &lt; b &amp; &quot;c&quot; &gt; d\tµ");
    }
}
