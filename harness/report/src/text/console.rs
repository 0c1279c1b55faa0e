//! Writes a run for a terminal. The text does not depend on the terminal's width.

mod progress;
mod summary;

pub use progress::{Progress, ProgressKind};

use super::escape::printable;
use super::timing;
use crate::document::{Cell, Style, Table, write_wrapped};
use crate::format;
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;
use std::io::{self, Write};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Detail {
    /// Lists what did not pass; empty if everything passed.
    Failures,
    #[default]
    Summary,
    Tables,
}

pub fn run_text(record: &RunRecord, style: Style, detail: Detail) -> String {
    let mut text = String::new();
    match detail {
        Detail::Failures if record.verdict == Verdict::Pass => {}
        Detail::Failures => summary::write_not_passed(&mut text, record, style),
        Detail::Summary => summary::write(&mut text, record, style, false),
        Detail::Tables => {
            for scenario in &record.scenarios {
                write_heading(&mut text, scenario, style);
                write_expectations(&mut text, scenario, style);
                text.push('\n');
            }
            summary::write(&mut text, record, style, true);
        }
    }
    text
}

/// Reason of the verdict in one line. The verdict may be that of an interrupted run.
pub fn verdict_reason(record: &RunRecord) -> String {
    summary::verdict_reason(record)
}

pub fn run_table(record: &RunRecord, style: Style) -> String {
    run_text(record, style, Detail::Tables)
}

/// Prints `text`. A closed pipe is no error.
pub fn print(text: &str, out: &mut dyn Write) -> io::Result<()> {
    match writeln!(out, "{}", text.trim_end()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

fn write_heading(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    let verdict = format!("{} {}", format::sign(scenario.verdict), scenario.verdict);
    let trials = format::count(scenario.trials.len(), "trial");
    let file = style.paint("1", &printable(&scenario.file));
    let verdict = style.paint_verdict(scenario.verdict, &verdict);
    // The other models are exact and are not mentioned.
    let is_simplified = matches!(scenario.model.as_str(), "linear" | "envelope");
    let model = if is_simplified { format!("model {}, ", scenario.model) } else { String::new() };
    let _ = writeln!(text, "{verdict}  {file}  (law {}, {model}{trials})", printable(&scenario.law));
    write_wrapped(text, "  ", "  ", &scenario.title);
    if let Some(sentence) = timing::summary(scenario) {
        write_wrapped(text, "  ", "  ", &sentence);
    }
}

fn write_expectations(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    if scenario.expectations.is_empty() {
        text.push_str("  no expectation was judged\n");
        return;
    }
    let dash = || "–".to_owned();
    let has_paper = scenario.expectations.iter().any(|expectation| expectation.paper.is_some());
    let columns = ["metric", "verdict", "value", "limit", "interval", "window"].into_iter();
    let mut table = Table::new(columns.chain(has_paper.then_some("paper")));
    for expectation in &scenario.expectations {
        let mut row = vec![
            Cell::from(expectation.name.as_str()),
            Cell::from(format::verdict(expectation)).with_verdict(expectation.verdict),
            format::value_or_not_reached(expectation).unwrap_or_else(dash).into(),
            format::limit(expectation).into(),
            format::interval(expectation).unwrap_or_else(dash).into(),
            format::windows(expectation).unwrap_or_else(dash).into(),
        ];
        row.extend(has_paper.then(|| Cell::from(expectation.paper.map_or_else(dash, format::number))));
        table.rows.push(row);
    }
    text.push('\n');
    for line in table.styled_lines(style) {
        let _ = writeln!(text, "  {line}");
    }
    for expectation in &scenario.expectations {
        if let Some(reason) = &expectation.reason {
            write_wrapped(text, "  ↳ ", "    ", &format!("{}: {reason}", expectation.name));
        }
    }
}
