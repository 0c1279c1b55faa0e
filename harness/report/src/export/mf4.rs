//! Writes ASAM MDF 4.10: a file per trial, so that a channel name is unique in its file.
//!
//! The data group has one channel group, its channels and one data block. Flags are bits of one
//! byte. The library mdf4-rs 0.6 is not used: it needs a newer compiler and writes neither start
//! time nor history.

mod blocks;

use crate::export::columns::{FLAG_COLUMNS, NUMBER_COLUMNS};
use crate::export::error::ExportError;
use crate::export::source::{ExportScenario, ExportTrial};
use blocks::{BlockWriter, Channel, ChannelKind};
use platebench_model::trace::AtPath;
use std::fmt::Write as _;
use std::fs::File;
use std::io;
use std::path::Path;

const RECORD_BYTES: usize = NUMBER_COLUMNS.len() * 8 + 1;

pub(crate) fn write(
    source: &ExportScenario<'_>,
    trial: &ExportTrial,
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
            kind: if place == 0 { ChannelKind::Time { byte } } else { ChannelKind::Real { byte } },
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
    trial: &ExportTrial,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_markup() {
        assert_eq!(escape_xml("a < b & \"c\" > d\u{0}\u{1b}\tµ"), "a &lt; b &amp; &quot;c&quot; &gt; d\tµ");
    }
}
