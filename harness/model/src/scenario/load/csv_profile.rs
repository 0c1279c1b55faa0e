//! Reads the CSV file of a profile, and finds its fields for messages.

use super::checker::Checker;
use super::profile::PointField;
use crate::input;
use crate::scenario::definition::InputFile;
use crate::scenario::diagnostic::Diagnostic;
use serde::Deserialize;
use std::ops::Range;
use std::path::Path;

/// An input file and its points: times in ms and values.
pub(super) type CsvProfile = (InputFile, Vec<[f64; 2]>);

/// `index` counts points from 1.
pub(super) fn csv_point_error(file: &InputFile, index: usize, part: PointField, message: String) -> Diagnostic {
    let text = String::from_utf8_lossy(&file.bytes);
    let span = csv_point_span(&text, index, part);
    Diagnostic::at_span(&file.path, &text, span, message)
}

impl Checker<'_> {
    /// Reads the file once, so that the run folder contains the bytes of the points. The columns are `t_ms`
    /// and `value`, in any order and between others; lines that begin with `#` are comments.
    pub(super) fn csv_profile(&self, key: &str, path: &Path) -> Result<CsvProfile, Diagnostic> {
        #[derive(Deserialize)]
        struct Row {
            t_ms: f64,
            value: f64,
        }
        let bytes = input::read(path).map_err(|error| self.unreadable_csv(key, path, &error.to_string()))?;
        let with_place = |error: csv::Error| self.csv_error(key, path, &bytes, &error);
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(&bytes[..]);
        let header = reader.headers().map_err(with_place)?.clone();
        for title in ["t_ms", "value"] {
            let mut places = (1..).zip(&header).filter(|(_, other)| *other == title).map(|(place, _)| place);
            if let (Some(first), Some(second)) = (places.next(), places.next()) {
                let text = String::from_utf8_lossy(&bytes);
                let span = field_span(&text, record_span(&text, 0), second - 1);
                let message = format!("columns {first} and {second} both have the title `{title}`, expected one");
                return Err(Diagnostic::at_span(path, &text, span, message));
            }
        }
        let points = reader.deserialize::<Row>().map(|row| row.map(|row| [row.t_ms, row.value]));
        let points = points.collect::<Result<_, _>>().map_err(with_place)?;
        Ok((InputFile { path: path.to_owned(), bytes }, points))
    }

    fn unreadable_csv(&self, key: &str, path: &Path, error: &str) -> Diagnostic {
        self.diagnostic(&format!("{key}.csv"), format!("profile file {} cannot be read: {error}", path.display()))
    }

    fn csv_error(&self, key: &str, path: &Path, bytes: &[u8], error: &csv::Error) -> Diagnostic {
        let text = String::from_utf8_lossy(bytes);
        let (span, message) = match error.kind() {
            csv::ErrorKind::Deserialize { pos: Some(position), err } => {
                let line = record_span(&text, position.record());
                let column = err.field().and_then(|field| usize::try_from(field).ok());
                let span = column.map_or(line.clone(), |column| field_span(&text, line, column));
                (span, format!("{}, expected a number in each of the columns `t_ms` and `value`", err.kind()))
            }
            csv::ErrorKind::UnequalLengths { pos: Some(position), expected_len, len } => {
                let message = format!("{len} fields, expected {expected_len} as in the header");
                (record_span(&text, position.record()), message)
            }
            csv::ErrorKind::Utf8 { pos: Some(position), .. } => {
                let span = record_span(&text, position.record());
                (span, "not UTF-8, expected a text file in UTF-8".to_owned())
            }
            _ => return self.unreadable_csv(key, path, &error.to_string()),
        };
        Diagnostic::at_span(path, &text, span, message)
    }
}

/// Byte range of the CSV record `number`. The header is record 0; comments do not count.
fn record_span(text: &str, number: u64) -> Range<usize> {
    let mut start = 0;
    let mut counted = 0;
    for line in text.split_inclusive('\n') {
        let content = line.trim_end();
        if !content.is_empty() && !line.starts_with('#') {
            if counted == number {
                return start..start + content.len();
            }
            counted += 1;
        }
        start += line.len();
    }
    0..0
}

/// Byte range of a field of `line`. `column` counts from 0.
fn field_span(text: &str, line: Range<usize>, column: usize) -> Range<usize> {
    let mut start = line.start;
    for (index, field) in text.get(line.clone()).unwrap_or_default().split(',').enumerate() {
        if index == column {
            let from = start + field.len() - field.trim_start().len();
            return from..from + field.trim().len();
        }
        start += field.len() + 1;
    }
    line
}

fn csv_point_span(text: &str, index: usize, part: PointField) -> Range<usize> {
    let header = text.get(record_span(text, 0)).unwrap_or_default();
    let name = match part {
        PointField::Time => "t_ms",
        PointField::Value | PointField::Period => "value",
    };
    let column = header.split(',').position(|field| field.trim() == name).unwrap_or(0);
    field_span(text, record_span(text, index as u64), column)
}
