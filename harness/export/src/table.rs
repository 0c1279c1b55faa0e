//! CSV: one tidy table of the whole run, a row per row of a trace and a column per variable, and beside it what the
//! columns are, as the W3C's "Metadata Vocabulary for Tabular Data" wants it.

use crate::columns::{FLAG_COLUMNS, NUMBER_COLUMNS};
use crate::error::ExportError;
use crate::source::ExportScenario;
use serde::Serialize;
use serde_json::json;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// The table's name.
pub(crate) const FILE: &str = "traces.csv";

/// Where the description of the table at `path` lies, so that readers of tabular metadata find it.
pub(crate) fn description_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push("-metadata.json");
    PathBuf::from(name)
}

/// One row. Numbers are written in the shortest form that parses back to the same double; what nobody knows is empty.
#[derive(Serialize)]
struct TableRow<'a> {
    scenario: &'a str,
    trial: u32,
    seed: u64,
    numbers: [Option<f64>; NUMBER_COLUMNS.len()],
    flags: [bool; FLAG_COLUMNS.len()],
}

const KEY_COLUMNS: [(&str, &str, &str); 3] = [
    ("scenario", "string", "which scenario"),
    ("trial", "integer", "which trial of the scenario, counted from 0"),
    ("seed", "integer", "what the trial's plate, sensor and noise were drawn from"),
];

/// Writes the rows of all scenarios.
pub(crate) fn write(sources: &[ExportScenario<'_>], file: File, path: &Path) -> Result<(), ExportError> {
    let refused = ExportError::format::<csv::Error>(path);
    let mut table = csv::WriterBuilder::new().has_headers(false).from_writer(file);
    let keys = KEY_COLUMNS.iter().map(|(name, ..)| *name);
    let header =
        keys.chain(NUMBER_COLUMNS.iter().map(|number| number.name)).chain(FLAG_COLUMNS.iter().map(|mark| mark.name));
    table.write_record(header).map_err(&refused)?;
    for source in sources {
        for trial in &source.trials {
            for row in trial.rows()? {
                let row = row?;
                let line = TableRow {
                    scenario: source.name,
                    trial: trial.index,
                    seed: trial.seed,
                    numbers: NUMBER_COLUMNS.map(|number| number.known_value(&row)),
                    flags: FLAG_COLUMNS.map(|mark| row.flags.contains(mark.flag)),
                };
                table.serialize(line).map_err(&refused)?;
            }
        }
    }
    table.flush().map_err(ExportError::io(path))
}

/// Writes what the table's columns are.
pub(crate) fn write_description(file: File, path: &Path) -> Result<(), ExportError> {
    let keys = KEY_COLUMNS
        .iter()
        .map(|(name, kind, meaning)| json!({"name": name, "datatype": kind, "dc:description": meaning}));
    let numbers = NUMBER_COLUMNS.iter().map(|number| {
        json!({"name": number.name, "datatype": "double", "unit": number.unit, "dc:description": number.meaning})
    });
    let marks = FLAG_COLUMNS
        .iter()
        .map(|mark| json!({"name": mark.name, "datatype": "boolean", "dc:description": mark.meaning}));
    let columns: Vec<_> = keys.chain(numbers).chain(marks).collect();
    let description = json!({
        "@context": "http://www.w3.org/ns/csvw",
        "url": FILE,
        "tableSchema": { "columns": columns },
    });
    let mut file = BufWriter::new(file);
    serde_json::to_writer_pretty(&mut file, &description).map_err(ExportError::format(path))?;
    file.write_all(b"\n").and_then(|()| file.flush()).map_err(ExportError::io(path))
}
