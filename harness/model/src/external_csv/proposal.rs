//! Proposes `--columns` from the titles and units of a table.

use crate::external_csv::columns::{ColumnRole, ROLES, canonical_unit};
use crate::external_csv::dialect::{MAX_PREAMBLE, Titles, bare_unit, decode, title_line};
use std::io::Read;

/// Beginnings of titles in lower case, by role. The more particular ones come first.
const TITLES: [(&str, ColumnRole); 17] = [
    ("temp", ColumnRole::Temperature),
    ("force", ColumnRole::Force),
    ("setpoint", ColumnRole::Setpoint),
    ("time", ColumnRole::Time),
    ("date", ColumnRole::Time),
    ("t", ColumnRole::Time),
    ("drive", ColumnRole::Drive),
    ("volt", ColumnRole::Drive),
    ("v", ColumnRole::Drive),
    ("freq", ColumnRole::Frequency),
    ("f", ColumnRole::Frequency),
    ("wd", ColumnRole::Wd),
    ("wq", ColumnRole::Wq),
    ("x", ColumnRole::Wd),
    ("y", ColumnRole::Wq),
    ("amp", ColumnRole::Amplitude),
    ("phase", ColumnRole::Phase),
];

/// `ROLE=TITLE:UNIT` for each title that is recognised. `UNIT` stands for a unit that the table does
/// not state clearly, such as `V`, which may be peak, peak to peak or RMS. `None` without a title for
/// time and for the drive.
pub fn propose_columns(table: impl Read) -> Option<String> {
    let (text, _) = decode(table).ok()?;
    let (titles, units) = titles_above_numbers(&text)?;
    let mut proposed: Vec<(ColumnRole, String)> = Vec::new();
    for (place, title) in titles.cells.iter().enumerate() {
        let (name, in_title) = split_unit(title);
        let lower = name.to_lowercase();
        let matches = |(start, _): &&(&str, ColumnRole)| {
            if start.len() == 1 { lower == *start } else { lower.starts_with(start) }
        };
        let Some((_, role)) = TITLES.iter().find(matches) else { continue };
        if proposed.iter().any(|(known, _)| known == role) {
            continue;
        }
        let below = units.as_ref().and_then(|units| units.get(place)).map(bare_unit);
        let unit = canonical_unit(in_title.or(below).unwrap_or_default());
        let (key, _, known, _) = ROLES.iter().find(|entry| entry.1 == *role)?;
        // A title `V`, `um` or `nm` does not say whether it is peak, peak to peak or RMS.
        let is_clear =
            known.iter().any(|entry| entry.0 == unit) && !["V", "mV", "um", "nm", "m"].contains(&unit.as_str());
        proposed.push((*role, format!("{key}={title}:{}", if is_clear { &unit } else { "UNIT" })));
    }
    let has = |role: ColumnRole| proposed.iter().any(|(known, _)| *known == role);
    let is_useful = has(ColumnRole::Time) && has(ColumnRole::Drive);
    is_useful.then(|| proposed.into_iter().map(|(_, column)| column).collect::<Vec<_>>().join(","))
}

/// Name and unit of `name (unit)` or `name [unit]`.
fn split_unit(title: &str) -> (&str, Option<&str>) {
    let split = title.trim_end_matches([')', ']']).rsplit_once(['(', '[']);
    split.map_or((title.trim(), None), |(name, unit)| (name.trim(), Some(unit.trim())))
}

/// The titles above the first line of numbers, and the row of units between them.
fn titles_above_numbers(text: &str) -> Option<(Titles, Option<csv::StringRecord>)> {
    let lines: Vec<_> =
        text.lines().take(MAX_PREAMBLE).enumerate().filter(|(_, line)| !line.trim().is_empty()).collect();
    let cells =
        |at: usize, delimiter: u8| lines.get(at).and_then(|(before, line)| title_line(*before, line, delimiter));
    let is_number = |cell: &str| cell.is_empty() || cell.replacen(',', ".", 1).parse::<f64>().is_ok();
    for delimiter in *b";\t," {
        let is_data = |at: &usize| {
            cells(*at, delimiter).is_some_and(|line| line.cells.len() > 3 && line.cells.iter().all(is_number))
        };
        let Some(first) = (0..lines.len()).find(is_data).filter(|first| *first > 0) else { continue };
        let above = cells(first - 1, delimiter)?;
        let is_unit = |cell: &str| {
            let bare = canonical_unit(bare_unit(cell));
            bare.is_empty() || ROLES.iter().any(|role| role.2.iter().any(|unit| unit.0 == bare))
        };
        if first > 1 && above.cells.iter().all(is_unit) {
            return Some((cells(first - 2, delimiter)?, Some(above.cells.clone())));
        }
        return Some((above, None));
    }
    None
}
