//! Reads a CSV with named columns, such as the 1 kHz telemetry of a real plate.

use crate::recording::{RecordedInput, RecordedSample, Recording, RecordingError};
use platebench_plate::{Complex64, Conditions};
use std::f64::consts::TAU;
use std::io::Read;
use std::str::FromStr;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ColumnRole {
    Time,
    Drive,
    Frequency,
    Wd,
    Wq,
    Temperature,
    Force,
    Setpoint,
}

/// Names of units with their factors to s, Vpp, rad/s, µm, K and N.
type Units = &'static [(&'static str, f64)];
/// Name of the role, role, units, and whether the column is required.
const ROLES: [(&str, ColumnRole, Units, bool); 8] = [
    ("time", ColumnRole::Time, &[("s", 1.0), ("ms", 1e-3), ("us", 1e-6)], true),
    ("drive", ColumnRole::Drive, &[("Vpp", 1.0), ("V", 2.0)], true),
    ("frequency", ColumnRole::Frequency, &[("Hz", TAU), ("kHz", TAU * 1e3), ("rad/s", 1.0)], true),
    ("wd", ColumnRole::Wd, &[("um", 1.0), ("nm", 1e-3), ("m", 1e6)], true),
    ("wq", ColumnRole::Wq, &[("um", 1.0), ("nm", 1e-3), ("m", 1e6)], true),
    ("temperature", ColumnRole::Temperature, &[("K", 1.0)], false),
    ("force", ColumnRole::Force, &[("N", 1.0)], false),
    ("setpoint", ColumnRole::Setpoint, &[("um", 1.0), ("nm", 1e-3), ("m", 1e6)], false),
];

/// `time=COLUMN:UNIT,drive=…,frequency=…,wd=…,wq=…[,temperature=…][,force=…][,setpoint=…]`
///
/// Every role needs a unit, because `drive=V` could name a column or a unit. The units are time s,
/// ms, us · drive Vpp, V (amplitude, half of Vpp) · frequency Hz, kHz, rad/s · wd and wq um, nm, m,
/// peak to peak, with `-` before the unit for a reversed sign · temperature K above the reference ·
/// force N · setpoint um, nm, m. Drive and frequency of a row act from the time of the row on; Wd
/// and Wq are sampled at this time.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnMapping(Vec<(ColumnRole, String, f64)>);

impl FromStr for ColumnMapping {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut columns: Vec<(ColumnRole, String, f64)> = Vec::new();
        for part in text.split(',') {
            let known = ROLES.map(|role| role.0).join(", ");
            let (key, rest) =
                part.split_once('=').ok_or(format!("`{part}`, expected ROLE=COLUMN:UNIT with a role of {known}"))?;
            let found = ROLES.iter().find(|role| role.0 == key.trim());
            let (_, role, units, _) = found.ok_or(format!("`{key}`, expected a role of {known}"))?;
            let listed = units.iter().map(|unit| unit.0).collect::<Vec<_>>().join(" or ");
            let (name, unit) = rest.rsplit_once(':').ok_or_else(|| {
                format!("`{part}` names the column `{rest}` without its unit, expected {part}:UNIT with {listed}")
            })?;
            let is_signed = matches!(role, ColumnRole::Wd | ColumnRole::Wq);
            let (sign, bare) = match unit.trim().strip_prefix('-').filter(|_| is_signed) {
                Some(bare) => (-1.0, bare),
                None => (1.0, unit.trim()),
            };
            let known = units.iter().find(|known| known.0 == bare);
            let factor = known.ok_or(format!("unit `{unit}` of {key}, expected {listed}"))?.1;
            if name.trim().is_empty() {
                return Err(format!("`{part}` names no column, expected {key}=COLUMN:{unit}"));
            }
            if columns.iter().any(|(known, _, _)| known == role) {
                return Err(format!("two columns for the role {key}, expected one"));
            }
            if columns.iter().any(|(_, known, _)| known == name.trim()) {
                return Err(format!("the column `{}` has two roles, expected one", name.trim()));
            }
            columns.push((*role, name.trim().to_owned(), factor * sign));
        }
        let missing = ROLES.iter().find(|role| role.3 && !columns.iter().any(|column| column.0 == role.1));
        missing.map_or(Ok(Self(columns)), |role| {
            Err(format!("no column for the role {0}, expected {0}=COLUMN:UNIT", role.0))
        })
    }
}

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

pub fn read(name: &str, table: impl Read, columns: &ColumnMapping) -> Result<Recording, ExternalCsvError> {
    let rows = read_rows(name, table, columns)?;
    let input =
        |row: &TelemetryRow| RecordedInput { t: row.t, vpp: row.vpp, omega: row.omega, conditions: row.conditions };
    let inputs = rows.iter().map(input).collect();
    let outputs = rows.iter().map(|row| RecordedSample { t: row.t, w: row.w }).collect();
    Recording::new(name.to_owned(), inputs, outputs).map_err(|error| ExternalCsvError::Unusable(name.to_owned(), error))
}

pub fn read_rows(name: &str, table: impl Read, columns: &ColumnMapping) -> Result<Vec<TelemetryRow>, ExternalCsvError> {
    let error_at = |line: u64, message: String| ExternalCsvError::Content { name: name.to_owned(), line, message };
    let csv_error = |error: csv::Error| error_at(error.position().map_or(1, csv::Position::line), error.to_string());
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(table);
    let header = reader.headers().map_err(csv_error)?.clone();
    let mut places = Vec::new();
    for (role, wanted, factor) in &columns.0 {
        let mut found = (0..).zip(&header).filter(|(_, title)| title == wanted).map(|(place, _)| place);
        let titles = || header.iter().collect::<Vec<_>>().join(", ");
        let place: usize = found.next().ok_or_else(|| {
            error_at(1, format!("no column `{wanted}` in: {}; --columns names the columns", titles()))
        })?;
        if let Some(second) = found.next() {
            let (first, second) = (place + 1, second + 1);
            let message =
                format!("columns {first} and {second} both have the title `{wanted}`, expected one; rename one");
            return Err(error_at(1, message));
        }
        places.push((*role, place, *factor));
    }
    let has_setpoint = columns.0.iter().any(|column| column.0 == ColumnRole::Setpoint);
    let mut rows: Vec<TelemetryRow> = Vec::new();
    let mut record = csv::StringRecord::new();
    while reader.read_record(&mut record).map_err(csv_error)? {
        let line = record.position().map_or(0, csv::Position::line);
        let mut values = [0.0; ROLES.len()];
        for (role, place, factor) in &places {
            let text = record.get(*place).unwrap_or("");
            let value = text.parse().ok().filter(|value: &f64| value.is_finite());
            let (column, title) = (place + 1, header.get(*place).unwrap_or(""));
            let found = |expected: &str| {
                error_at(line, format!("column {column} (`{title}`) is `{text}`, expected {expected}"))
            };
            let value = value.ok_or_else(|| found("a finite number"))? * factor;
            match role {
                ColumnRole::Time if rows.last().is_some_and(|last| last.t >= value) => {
                    return Err(found("a time after that of the row above"));
                }
                ColumnRole::Drive if value < 0.0 => return Err(found("0 or more")),
                ColumnRole::Frequency if value <= 0.0 => return Err(found("a frequency above 0")),
                _ => values[*role as usize] = value,
            }
        }
        let [t, vpp, omega, wd, wq, temperature_offset_k, finger_force_n, setpoint_um] = values;
        rows.push(TelemetryRow {
            t,
            vpp,
            omega,
            w: Complex64::new(wd, wq),
            conditions: Conditions { temperature_offset_k, finger_force_n },
            setpoint_um: has_setpoint.then_some(setpoint_um),
        });
    }
    Ok(rows)
}
