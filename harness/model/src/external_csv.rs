//! Reads a CSV with named columns, such as the 1 kHz telemetry of a real plate or the file of an
//! instrument.

mod columns;
mod dialect;
mod proposal;

pub use columns::ColumnMapping;
pub use dialect::Dialect;
pub use proposal::propose_columns;

use crate::recording::{RecordedInput, RecordedSample, Recording, RecordingError};
use columns::{ColumnRole, Scale};
use platebench_plate::{Complex64, Conditions};
use std::io::Read;

/// Largest negative drive that counts as noise, as a share of the highest drive.
const MAX_NEGATIVE_SHARE: f64 = 0.02;

#[derive(Debug, thiserror::Error)]
pub enum ExternalCsvError {
    #[error("{name}:{line}: {message}")]
    Content { name: String, line: u64, message: String },
    #[error("{0}: {1}")]
    Unusable(String, RecordingError),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TelemetryRow {
    /// Time since the table's origin, s.
    pub t: f64,
    pub vpp: f64,
    /// Excitation frequency, rad/s.
    pub omega: f64,
    pub w: Complex64,
    pub conditions: Conditions,
    pub setpoint_um: Option<f64>,
}

#[derive(Debug)]
pub struct TelemetryTable {
    /// In order of time.
    pub rows: Vec<TelemetryRow>,
    pub dialect: Dialect,
}

pub fn read(name: &str, table: impl Read, columns: &ColumnMapping) -> Result<(Recording, Dialect), ExternalCsvError> {
    let TelemetryTable { rows, dialect } = read_rows(name, table, columns)?;
    let input =
        |row: &TelemetryRow| RecordedInput { t: row.t, vpp: row.vpp, omega: row.omega, conditions: row.conditions };
    let inputs = rows.iter().map(input).collect();
    let outputs = rows.iter().map(|row| RecordedSample { t: row.t, w: row.w }).collect();
    let recording = Recording::new(name.to_owned(), inputs, outputs);
    recording.map(|recording| (recording, dialect)).map_err(|error| ExternalCsvError::Unusable(name.to_owned(), error))
}

/// Fails at the first cell that is no valid number.
pub fn read_rows(name: &str, table: impl Read, columns: &ColumnMapping) -> Result<TelemetryTable, ExternalCsvError> {
    let error_at = |line: u64, message: String| ExternalCsvError::Content { name: name.to_owned(), line, message };
    let (text, is_latin) = dialect::decode(table).map_err(|message| error_at(1, message))?;
    let titles = dialect::find_titles(&text, columns).map_err(|(line, message)| error_at(line, message))?;
    let mut dialect = Dialect { is_latin, ..titles.dialect };
    let mut places = Vec::new();
    for column in columns.iter() {
        let place = titles.place(&column.title).map_err(|message| error_at(titles.line, message))?;
        places.push((column, place));
    }
    let mut constants = [0.0; ColumnRole::COUNT];
    for (role, value) in columns.constants() {
        if let Some(slot) = constants.get_mut(role as usize) {
            *slot = value;
        }
    }
    let mut rows: Vec<TelemetryRow> = Vec::new();
    // The lowest drive with its error. Noise of an instrument may be negative.
    let mut lowest: Option<(f64, ExternalCsvError)> = None;
    let mut marks = DecimalMarks::default();
    let mut first_instant = None;
    for record in titles.data(&text) {
        let record = record.map_err(|(line, message)| error_at(line, message))?;
        if rows.is_empty() && !dialect.has_units_row && dialect::is_units_row(&record, &places) {
            for (column, place) in &places {
                let unit = dialect::bare_unit(record.cells.get(*place).unwrap_or(""));
                column.check_unit(unit).map_err(|message| error_at(record.line, message))?;
            }
            dialect.has_units_row = true;
            continue;
        }
        let mut values = constants;
        for (column, place) in &places {
            let cell = record.cells.get(*place).unwrap_or("");
            let found = |expected: &str| {
                let (number, title) = (place + 1, &column.title);
                error_at(record.line, format!("column {number} (`{title}`) is `{cell}`, expected {expected}"))
            };
            let value = match column.scale {
                Scale::Constant(value) => value,
                Scale::Factor { factor, offset } => {
                    let number = marks.parse(cell, titles.dialect.delimiter);
                    let number = number.map_err(|message| error_at(record.line, message))?;
                    let finite = number.filter(|value| value.is_finite());
                    (finite.ok_or_else(|| found("a finite number"))? - offset) * factor
                }
                Scale::Instant => {
                    let instant = columns::parse_instant(cell).ok_or_else(|| found("a date and a time, ISO 8601"))?;
                    let first = *first_instant.get_or_insert(instant);
                    (instant - first) as f64 * 1e-9
                }
            };
            match column.role {
                ColumnRole::Time if rows.last().is_some_and(|last| last.t >= value) => {
                    return Err(found("a time after that of the row above"));
                }
                ColumnRole::Amplitude if value < 0.0 => return Err(found("0 or more")),
                ColumnRole::Drive if value < 0.0 => {
                    if lowest.as_ref().is_none_or(|(least, _)| value < *least) {
                        let expected = "0 or more, or noise of at most 2 % of the highest drive, which counts as 0";
                        lowest = Some((value, found(expected)));
                    }
                }
                ColumnRole::Frequency if value <= 0.0 => return Err(found("a frequency above 0")),
                role => {
                    if let Some(slot) = values.get_mut(role as usize) {
                        *slot = value;
                    }
                }
            }
        }
        rows.push(TelemetryRow::new(values, columns));
    }
    let highest = rows.iter().map(|row| row.vpp).fold(0.0, f64::max);
    if let Some((_, error)) = lowest.filter(|(least, _)| *least < -MAX_NEGATIVE_SHARE * highest) {
        return Err(error);
    }
    dialect.has_decimal_commas = marks.has_commas;
    Ok(TelemetryTable { rows, dialect })
}

/// Decimal marks that occurred. A table has commas or points, because 1,234 could be either.
#[derive(Debug, Default)]
struct DecimalMarks {
    has_commas: bool,
    has_points: bool,
}

impl DecimalMarks {
    /// `None` if the cell is not a number. Fails if the table has both decimal marks.
    fn parse(&mut self, cell: &str, delimiter: u8) -> Result<Option<f64>, String> {
        let has_comma = delimiter != b',' && cell.contains(',');
        self.has_commas |= has_comma;
        self.has_points |= cell.contains('.');
        if self.has_commas && self.has_points {
            return Err(format!("`{cell}`: the table has decimal commas and decimal points, expected one of them"));
        }
        let number = if has_comma { cell.replacen(',', ".", 1).parse() } else { cell.parse() };
        Ok(number.ok())
    }
}

impl TelemetryRow {
    fn new(values: [f64; ColumnRole::COUNT], columns: &ColumnMapping) -> Self {
        let value = |role: ColumnRole| values.get(role as usize).copied().unwrap_or(0.0);
        let w = if columns.has(ColumnRole::Amplitude) {
            Complex64::from_polar(value(ColumnRole::Amplitude), value(ColumnRole::Phase))
        } else {
            Complex64::new(value(ColumnRole::Wd), value(ColumnRole::Wq))
        };
        Self {
            t: value(ColumnRole::Time),
            vpp: value(ColumnRole::Drive),
            omega: value(ColumnRole::Frequency),
            w,
            conditions: Conditions {
                temperature_offset_k: value(ColumnRole::Temperature),
                finger_force_n: value(ColumnRole::Force),
            },
            setpoint_um: columns.has(ColumnRole::Setpoint).then(|| value(ColumnRole::Setpoint)),
        }
    }
}
