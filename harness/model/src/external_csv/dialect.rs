//! Finds the titles in a file of another program: delimiter, lines before the titles, a row of units.

use crate::external_csv::columns::{Column, ColumnMapping};
use std::fmt;
use std::io::Read;

/// Lines before the titles that are searched. The longest preamble of an instrument has some 40.
pub(super) const MAX_PREAMBLE: usize = 200;
const DELIMITERS: [u8; 3] = *b",;\t";

/// Form of a table. Displays as a list of what differs from a CSV with titles in its first line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dialect {
    pub lines_before_titles: usize,
    pub delimiter: u8,
    pub has_decimal_commas: bool,
    /// The row below the titles has units.
    pub has_units_row: bool,
    /// The file is not UTF-8, so each byte is a character of ISO 8859-1.
    pub is_latin: bool,
}

impl Dialect {
    pub fn is_plain(&self) -> bool {
        let Self { lines_before_titles, delimiter, has_decimal_commas, has_units_row, is_latin } = *self;
        lines_before_titles == 0 && delimiter == b',' && !(has_decimal_commas || has_units_row || is_latin)
    }
}

impl fmt::Display for Dialect {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let delimiter = match self.delimiter {
            b';' => "semicolons",
            b'\t' => "tabs",
            _ => "commas",
        };
        write!(formatter, "{} lines before the titles, {delimiter} between the columns", self.lines_before_titles)?;
        let others = [
            (self.has_decimal_commas, "decimal commas"),
            (self.has_units_row, "a row of units"),
            (self.is_latin, "ISO 8859-1"),
        ];
        others.iter().filter(|(holds, _)| *holds).try_for_each(|(_, text)| write!(formatter, ", {text}"))
    }
}

/// Text of the file, and whether it is ISO 8859-1. Fails for UTF-16.
pub(super) fn decode(mut table: impl Read) -> Result<(String, bool), String> {
    let mut bytes = Vec::new();
    table.read_to_end(&mut bytes).map_err(|error| error.to_string())?;
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err("UTF-16, expected UTF-8 or ISO 8859-1; save the table as \"CSV UTF-8\"".to_owned());
    }
    match String::from_utf8(bytes) {
        Ok(text) => Ok((text.trim_start_matches('\u{feff}').to_owned(), false)),
        Err(error) => Ok((error.into_bytes().iter().map(|byte| char::from(*byte)).collect(), true)),
    }
}

#[derive(Debug)]
pub(super) struct Titles {
    pub(super) cells: csv::StringRecord,
    /// Line of the titles, from 1.
    pub(super) line: u64,
    pub(super) dialect: Dialect,
}

#[derive(Debug)]
pub(super) struct Record {
    pub(super) line: u64,
    pub(super) cells: csv::StringRecord,
}

/// A line and a message.
type LineError = (u64, String);

impl Titles {
    /// Place of a title from 0. `TITLE#2` is the second column of this title.
    pub(super) fn place(&self, wanted: &str) -> Result<usize, String> {
        let places = |title: &str| -> Vec<usize> {
            (0..).zip(&self.cells).filter(|(_, cell)| *cell == title).map(|(place, _)| place).collect()
        };
        match places(wanted)[..] {
            [place] => return Ok(place),
            [first, second, ..] => {
                let (first, second) = (first + 1, second + 1);
                return Err(format!(
                    "columns {first} and {second} both have the title `{wanted}`; expected {wanted}#1 or {wanted}#2"
                ));
            }
            [] => {}
        }
        let numbered = wanted.rsplit_once('#').and_then(|(title, number)| Some((title, number.parse::<usize>().ok()?)));
        let place = numbered.and_then(|(title, number)| places(title).get(number.checked_sub(1)?).copied());
        place.ok_or_else(|| self.missing(wanted))
    }

    fn missing(&self, wanted: &str) -> String {
        let titles: Vec<_> = self.cells.iter().collect();
        format!("no column `{wanted}` in: {}; --columns names the columns", titles.join(", "))
    }

    /// The records below the titles.
    pub(super) fn data<'a>(&self, text: &'a str) -> impl Iterator<Item = Result<Record, LineError>> + use<'a> {
        let before = self.line as usize;
        let start = text.split_inclusive('\n').take(before).map(str::len).sum();
        records(text.get(start..).unwrap_or_default(), self.dialect.delimiter, before as u64, self.cells.len())
    }
}

/// Records of `text`, which begins after `lines_before` lines. Lines with `#` are comments.
fn records(
    text: &str,
    delimiter: u8,
    lines_before: u64,
    columns: usize,
) -> impl Iterator<Item = Result<Record, LineError>> {
    let mut builder = csv::ReaderBuilder::new();
    builder.trim(csv::Trim::All).has_headers(false).flexible(true).delimiter(delimiter).comment(Some(b'#'));
    builder.from_reader(text.as_bytes()).into_records().map(move |record| {
        let line_of = |position: Option<&csv::Position>| position.map_or(1, csv::Position::line) + lines_before;
        let cells = record.map_err(|error| (line_of(error.position()), error.to_string()))?;
        let line = line_of(cells.position());
        // A row may lack columns without a role. A further one moves all values, as decimal commas do.
        if cells.iter().skip(columns).any(|cell| !cell.is_empty()) {
            return Err((line, format!("{} columns, expected {columns} as in the titles", cells.len())));
        }
        Ok(Record { line, cells })
    })
}

/// The first line that contains all titles of the mapping. A line may begin with `#`. The error names
/// the titles of the line that contains most of them.
pub(super) fn find_titles(text: &str, columns: &ColumnMapping) -> Result<Titles, LineError> {
    let missing = |titles: &Titles| columns.iter().filter(|column| is_missing(titles, &column.title)).count();
    let mut best: Option<(usize, Titles)> = None;
    for (before, line) in text.lines().take(MAX_PREAMBLE).enumerate() {
        for titles in DELIMITERS.into_iter().filter_map(|delimiter| title_line(before, line, delimiter)) {
            let count = missing(&titles);
            if count == 0 {
                return Ok(titles);
            }
            if best.as_ref().is_none_or(|(fewest, _)| count < *fewest) {
                best = Some((count, titles));
            }
        }
    }
    let Some((_, titles)) = best else { return Err((1, "the table is empty, expected titles".to_owned())) };
    let wanted = columns.iter().find(|column| is_missing(&titles, &column.title));
    Err((titles.line, titles.missing(wanted.map_or("", |column| &column.title))))
}

fn is_missing(titles: &Titles, wanted: &str) -> bool {
    titles.place(wanted).is_err() && !titles.cells.iter().any(|cell| cell == wanted)
}

/// The cells of a line, if it is not empty.
pub(super) fn title_line(before: usize, line: &str, delimiter: u8) -> Option<Titles> {
    let bare = line.trim_start_matches(['#', ' ']);
    let mut builder = csv::ReaderBuilder::new();
    builder.trim(csv::Trim::All).has_headers(false).flexible(true).delimiter(delimiter);
    let cells = builder.from_reader(bare.as_bytes()).into_records().next()?.ok()?;
    let dialect = Dialect {
        lines_before_titles: before,
        delimiter,
        has_decimal_commas: false,
        has_units_row: false,
        is_latin: false,
    };
    Some(Titles { cells, line: before as u64 + 1, dialect })
}

/// True if each used cell is empty or a unit, and at least one is a unit.
pub(super) fn is_units_row(record: &Record, places: &[(&Column, usize)]) -> bool {
    let cells = || places.iter().map(|(_, place)| record.cells.get(*place).unwrap_or(""));
    let is_unit = |cell: &str| {
        let bare = bare_unit(cell);
        bare.parse::<f64>().is_err() && bare.chars().all(|letter| letter.is_alphabetic() || "°/%_-".contains(letter))
    };
    cells().all(is_unit) && cells().any(|cell| !cell.is_empty())
}

/// The unit without brackets.
pub(super) fn bare_unit(cell: &str) -> &str {
    cell.trim().trim_matches(['(', ')', '[', ']'])
}
