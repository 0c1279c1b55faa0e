//! Writes CSV: one tidy table of the whole run, and a description of its columns by the W3C's
//! "Metadata Vocabulary for Tabular Data".

use crate::export::source::{ExportError, ExportScenario, FLAG_COLUMNS, NUMBER_COLUMNS, Number};
use platebench_document::without_formula;
use platebench_model::trace::AtPath;
use serde::Serialize;
use serde_json::json;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

pub(crate) const FILE: &str = "traces.csv";

/// Appends `-metadata.json`, the suffix that the W3C specifies.
pub(crate) fn description_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push("-metadata.json");
    PathBuf::from(name)
}

/// Numbers have the shortest form that parses to the same double. Unknown numbers are empty.
#[derive(Serialize)]
struct TableRow<'a> {
    scenario: &'a str,
    trial: u32,
    seed: u64,
    numbers: [Option<f64>; NUMBER_COLUMNS.len()],
    flags: [bool; FLAG_COLUMNS.len()],
}

const KEY_COLUMNS: [(&str, &str, &str); 3] = [
    ("scenario", "string", "scenario"),
    ("trial", "integer", "trial of the scenario, counted from 0"),
    ("seed", "integer", "seed of plate, sensor and noise of the trial"),
];

pub(crate) fn write(sources: &[ExportScenario<'_>], file: &File, path: &Path) -> Result<(), ExportError> {
    let format_error = ExportError::format::<csv::Error>(path);
    let mut table = csv::WriterBuilder::new().has_headers(false).from_writer(file);
    let keys = KEY_COLUMNS.iter().map(|(name, ..)| *name);
    let header = keys.chain(NUMBER_COLUMNS.iter().map(Number::name)).chain(FLAG_COLUMNS.iter().map(|flag| flag.name));
    table.write_record(header).map_err(&format_error)?;
    for source in sources {
        let scenario = without_formula(source.name);
        for trial in &source.trials {
            for row in trial.rows()? {
                let row = row?;
                let line = TableRow {
                    scenario: &scenario,
                    trial: trial.index,
                    seed: trial.seed,
                    numbers: NUMBER_COLUMNS.map(|number| number.known_value(&row)),
                    flags: FLAG_COLUMNS.map(|flag| row.flags.contains(flag.flag)),
                };
                table.serialize(line).map_err(&format_error)?;
            }
        }
    }
    Ok(table.flush().at(path)?)
}

pub(crate) fn write_description(file: &File, path: &Path) -> Result<(), ExportError> {
    let keys = KEY_COLUMNS
        .iter()
        .map(|(name, kind, meaning)| json!({"name": name, "datatype": kind, "dc:description": meaning}));
    let numbers = NUMBER_COLUMNS.iter().map(|number| {
        json!({
            "name": number.name(),
            "datatype": "double",
            "schema:unitText": number.unit,
            "dc:description": number.meaning,
        })
    });
    let flags = FLAG_COLUMNS
        .iter()
        .map(|flag| json!({"name": flag.name, "datatype": "boolean", "dc:description": flag.meaning}));
    let columns: Vec<_> = keys.chain(numbers).chain(flags).collect();
    let description = json!({
        "@context": "http://www.w3.org/ns/csvw",
        "url": FILE,
        "tableSchema": { "columns": columns },
    });
    let mut file = BufWriter::new(file);
    serde_json::to_writer_pretty(&mut file, &description).map_err(ExportError::format(path))?;
    Ok(file.write_all(b"\n").and_then(|()| file.flush()).at(path)?)
}
