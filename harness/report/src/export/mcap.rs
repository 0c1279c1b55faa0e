//! Writes MCAP: a file per scenario, a topic per trial, a JSON message per row.
//!
//! The schema contains the units. The log time of every trial begins at the start of the run, so
//! that viewers overlay trials. The log time is rounded to whole nanoseconds. `t_s` is the exact
//! time.

use crate::export::source::{ExportError, ExportScenario, FLAG_COLUMNS, NUMBER_COLUMNS};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions};
use platebench_model::trace::{AtPath, Row};
use serde::{Serialize, Serializer};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

const CHUNK_BYTES: u64 = 1 << 20;
/// Messages are in time order within so many trials, whose traces are open at once.
const MAX_OPEN_TRACES: usize = 256;

pub(crate) fn write(source: &ExportScenario<'_>, file: &File, path: &Path) -> Result<(), ExportError> {
    let format_error = ExportError::format::<McapError>(path);
    let library = format!("{} {}", source.run.tool.name, source.run.tool.version);
    let options =
        WriteOptions::new().compression(Some(Compression::Lz4)).chunk_size(Some(CHUNK_BYTES)).library(library);
    let mut writer = options.create(BufWriter::new(file)).map_err(&format_error)?;
    let facts = source.metadata().into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
    writer.write_metadata(&Metadata { name: "platebench".to_owned(), metadata: facts }).map_err(&format_error)?;
    let units = NUMBER_COLUMNS.iter().map(|number| (number.name().to_owned(), number.unit.to_owned())).collect();
    writer.write_metadata(&Metadata { name: "units".to_owned(), metadata: units }).map_err(&format_error)?;
    let schema = serde_json::to_vec(&schema()).map_err(ExportError::format(path))?;
    let schema = writer.add_schema("platebench.Row", "jsonschema", &schema).map_err(&format_error)?;
    let mut text = Vec::new();
    for trials in source.trials.chunks(MAX_OPEN_TRACES) {
        let mut topics = Vec::with_capacity(trials.len());
        for trial in trials {
            let about = BTreeMap::from([("seed".to_owned(), trial.seed.to_string())]);
            let topic = format!("/trial/{:03}", trial.index);
            let channel_id = writer.add_channel(schema, &topic, "json", &about).map_err(&format_error)?;
            topics.push((channel_id, (0_u32..).zip(trial.rows()?)));
        }
        let time_of = |row: &Row| source.started_ns.saturating_add((row.t_s * 1e9).round() as u64);
        // The next row of each topic. Rows of one instant are in the order of the topics.
        let mut next: BTreeMap<(u64, usize), (u32, Row)> = BTreeMap::new();
        let mut due: Vec<usize> = (0..topics.len()).collect();
        loop {
            for index in due.drain(..) {
                if let Some((sequence, row)) = topics.get_mut(index).and_then(|(_, rows)| rows.next()) {
                    let row = row?;
                    next.insert((time_of(&row), index), (sequence, row));
                }
            }
            let Some(((log_time, index), (sequence, row))) = next.pop_first() else { break };
            text.clear();
            serde_json::to_writer(&mut text, &Message(&row)).map_err(ExportError::format(path))?;
            let channel_id = topics.get(index).map_or(0, |(channel_id, _)| *channel_id);
            let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &text).map_err(&format_error)?;
            due.push(index);
        }
    }
    writer.finish().map_err(&format_error)?;
    Ok(writer.into_inner().flush().at(path)?)
}

struct Message<'a>(&'a Row);

#[derive(Serialize)]
#[serde(untagged)]
enum Cell {
    Number(f64),
    Flag(bool),
}

impl Serialize for Message<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(row) = self;
        let numbers = NUMBER_COLUMNS.iter().filter_map(|number| Some((number.name(), number.known_value(row)?)));
        let numbers = numbers.map(|(name, value)| (name, Cell::Number(value)));
        let flags = FLAG_COLUMNS.iter().map(|flag| (flag.name, Cell::Flag(row.flags.contains(flag.flag))));
        serializer.collect_map(numbers.chain(flags))
    }
}

/// JSON Schema of a message. `unit` is an annotation, which validators ignore.
fn schema() -> Value {
    let numbers = NUMBER_COLUMNS.iter().map(|number| {
        let description = format!("{}, {}", number.meaning, number.unit);
        (number.name().to_owned(), json!({"type": "number", "description": description, "unit": number.unit}))
    });
    let flags =
        FLAG_COLUMNS.iter().map(|flag| (flag.name.to_owned(), json!({"type": "boolean", "description": flag.meaning})));
    let properties: Map<String, Value> = numbers.chain(flags).collect();
    // Viewers reject a list of types such as number or null, so an unknown number is missing.
    let optional = |name: &str| NUMBER_COLUMNS.iter().any(|number| number.name() == name && number.can_be_unknown());
    let required: Vec<&String> = properties.keys().filter(|name| !optional(name)).collect();
    json!({"title": "platebench.Row", "type": "object", "required": required, "properties": properties})
}
