//! MCAP: a recording for each scenario, with a topic for each trial, for Foxglove and its like.
//!
//! A message is a row as a JSON object; its schema names the units. Every trial begins when the run did, so that trials
//! lie over each other; `t_s` in the message is the exact time, the log time is that time in whole nanoseconds.

use crate::columns::{FLAG_COLUMNS, NUMBER_COLUMNS};
use crate::error::ExportError;
use crate::source::ExportScenario;
use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Bytes of a chunk, which is what is in memory.
const CHUNK_BYTES: u64 = 1 << 20;

/// Writes the scenario's recording.
pub(crate) fn write(source: &ExportScenario<'_>, file: File, path: &Path) -> Result<(), ExportError> {
    let refused = ExportError::format::<McapError>(path);
    let library = format!("{} {}", source.run.tool.name, source.run.tool.version);
    let options = WriteOptions::new().compression(None).chunk_size(Some(CHUNK_BYTES)).library(library);
    let mut writer = options.create(BufWriter::new(file)).map_err(&refused)?;
    let facts = source.metadata().into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
    writer.write_metadata(&Metadata { name: "platebench".to_owned(), metadata: facts }).map_err(&refused)?;
    let units = NUMBER_COLUMNS.iter().map(|number| (number.name.to_owned(), number.unit.to_owned())).collect();
    writer.write_metadata(&Metadata { name: "units".to_owned(), metadata: units }).map_err(&refused)?;
    let schema = serde_json::to_vec(&schema()).map_err(ExportError::format(path))?;
    let schema = writer.add_schema("platebench.Row", "jsonschema", &schema).map_err(&refused)?;
    let mut text = Vec::new();
    for trial in &source.trials {
        let about = BTreeMap::from([("seed".to_owned(), trial.seed.to_string())]);
        let topic = format!("/trial/{:03}", trial.index);
        let channel_id = writer.add_channel(schema, &topic, "json", &about).map_err(&refused)?;
        for (sequence, row) in (0_u32..).zip(trial.rows()?) {
            let row = row?;
            let numbers = NUMBER_COLUMNS.iter().map(|number| (number.name.to_owned(), json!(number.known_value(&row))));
            let marks =
                FLAG_COLUMNS.iter().map(|mark| (mark.name.to_owned(), Value::from(row.flags.contains(mark.flag))));
            let message: Map<String, Value> = numbers.chain(marks).collect();
            text.clear();
            serde_json::to_writer(&mut text, &message).map_err(ExportError::format(path))?;
            // Rounded once, from the exact time; a negative time has no place in the format.
            let log_time = source.started_ns.saturating_add((row.t_s * 1e9).round() as u64);
            let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &text).map_err(&refused)?;
        }
    }
    writer.finish().map_err(&refused)?;
    writer.into_inner().flush().map_err(ExportError::io(path))
}

/// What a message is, as JSON Schema; `unit` is an annotation that readers may use.
fn schema() -> Value {
    let numbers = NUMBER_COLUMNS.iter().map(|number| {
        let description = format!("{}, {}", number.meaning, number.unit);
        let kind = if number.can_be_unknown { json!(["number", "null"]) } else { json!("number") };
        (number.name.to_owned(), json!({"type": kind, "description": description, "unit": number.unit}))
    });
    let marks =
        FLAG_COLUMNS.iter().map(|mark| (mark.name.to_owned(), json!({"type": "boolean", "description": mark.meaning})));
    let properties: Map<String, Value> = numbers.chain(marks).collect();
    let required: Vec<&String> = properties.keys().collect();
    json!({"title": "platebench.Row", "type": "object", "required": required, "properties": properties})
}
