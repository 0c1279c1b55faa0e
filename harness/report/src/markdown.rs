//! A run on one page of Markdown: verdict, what to look at, every scenario in a line. For summaries of continuous
//! integration, comments and mails.
//!
//! At most `MOST` open points and scenarios are listed, and how many are not is said: GitHub refuses a summary above
//! 1 MiB as a whole.

use crate::error::ReportError;
use crate::{evidence, shown};
use platebench_verdict::RunRecord;
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;

/// Lines of a table.
const MOST: usize = 200;

/// Characters of a cell.
const WIDEST: usize = 400;

/// Writes the page to `path`, replacing what is there.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    fs::write(path, page(record)).map_err(ReportError::io(path))
}

/// Appends the page to `path`, which may not be there yet.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn append(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    let file = fs::OpenOptions::new().append(true).create(true).open(path);
    file.and_then(|mut file| file.write_all(format!("{}\n", page(record)).as_bytes())).map_err(ReportError::io(path))
}

/// The page.
pub fn page(record: &RunRecord) -> String {
    let mut text = String::new();
    let counts = shown::Counts::of_expectations(record);
    // Writing into a string does not fail.
    let _ = writeln!(text, "## {} platebench: {}\n", shown::sign(record.verdict), record.verdict);
    let scenarios = shown::count(record.scenarios.len(), "scenario");
    let trials = shown::count(record.scenarios.iter().map(|scenario| scenario.trials.len()).sum(), "trial");
    let firmware = record.rig.firmware.as_ref();
    let firmware = firmware.map_or_else(String::new, |found| format!(", firmware {} {}", found.name, found.version));
    let _ = writeln!(
        text,
        "{scenarios}, {trials}; expectations: {counts}. Rig {}{}, {}, started {}.\n",
        cell(&record.rig.name),
        cell(&firmware),
        cell(&record.clock),
        cell(&record.started)
    );
    if let Some(changed) = shown::overrides(record) {
        let _ = writeln!(text, "Not as the scenarios have it: {}.\n", cell(&changed));
    }
    if let Some(doubt) = evidence::doubt(record) {
        let _ = writeln!(text, "**{doubt}**\n");
    }
    if record.safe_confirmed == Some(false) {
        text +=
            "**The controller did not confirm 0 V at its end: see to the amplifier before you touch the plate.**\n\n";
    }
    open_points(&mut text, record);
    text += "| | Scenario | Verdict | Law | Trials | Expectations |\n|---|---|---|---|---|---|\n";
    for scenario in record.scenarios.iter().take(MOST) {
        let counts: shown::Counts = scenario.expectations.iter().map(|found| found.verdict).collect();
        let doubt = evidence::doubt_of(scenario).map_or_else(|| counts.to_string(), str::to_owned);
        let (sign, verdict) = (shown::sign(scenario.verdict), scenario.verdict);
        let (file, law, trials) = (cell(&scenario.file), cell(&scenario.law), scenario.trials.len());
        let _ = writeln!(text, "| {sign} | {file} | {verdict} | {law} | {trials} | {doubt} |");
    }
    more(&mut text, record.scenarios.len());
    text
}

/// What did not pass, failures first.
fn open_points(text: &mut String, record: &RunRecord) {
    let points = evidence::open_points(record);
    if points.is_empty() {
        return;
    }
    *text += "| | Scenario | Expected | Found | Requirement | Why | Trace |\n|---|---|---|---|---|---|---|\n";
    for (scenario, index) in points.iter().take(MOST) {
        let Some(expectation) = scenario.expectations.get(*index) else { continue };
        let (sign, verdict) = (shown::sign(expectation.verdict), shown::verdict(expectation));
        let expected = cell(&format!("{} {}", evidence::key(scenario, *index), shown::limit(expectation)));
        let found = shown::found(expectation).unwrap_or_else(|| "none".to_owned());
        let requirement = cell(expectation.requirement.as_deref().unwrap_or_default());
        let why = expectation.reason.as_deref().map_or(verdict.clone(), |reason| format!("{verdict}: {reason}"));
        let trace = evidence::trial(scenario, *index).map(|trial| cell(&trial.trace)).unwrap_or_default();
        let (file, why) = (cell(&scenario.file), cell(&why));
        let _ = writeln!(text, "| {sign} | {file} | {expected} | {found} | {requirement} | {why} | {trace} |");
    }
    more(text, points.len());
}

/// Ends a table, and says what it does not show.
fn more(text: &mut String, of: usize) {
    if of > MOST {
        let _ = writeln!(text, "\n… and {} more.", of - MOST);
    }
    text.push('\n');
}

/// Text in a cell of a table: nothing in it is markup, nothing ends the cell.
fn cell(text: &str) -> String {
    let mut cell = String::with_capacity(text.len());
    for character in text.chars().take(WIDEST) {
        match character {
            '\n' | '\r' => cell.push(' '),
            '<' => cell.push_str("&lt;"),
            '&' => cell.push_str("&amp;"),
            '|' | '\\' | '`' | '*' | '_' | '[' | ']' | '~' | '#' | '@' => {
                cell.push('\\');
                cell.push(character);
            }
            other => cell.push(other),
        }
    }
    if text.chars().nth(WIDEST).is_some() {
        cell.push('…');
    }
    cell
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_in_a_cell_is_markup() {
        assert_eq!(cell("a|b\n<img> & `x` [y](z)"), "a\\|b &lt;img> &amp; \\`x\\` \\[y\\](z)");
        assert_eq!(cell(&"x".repeat(WIDEST)).chars().count(), WIDEST);
        assert_eq!(cell(&"x".repeat(WIDEST + 1)).chars().count(), WIDEST + 1);
        assert!(cell(&"x".repeat(WIDEST + 1)).ends_with('…'));
    }
}
