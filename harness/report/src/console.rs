//! A run for a terminal: a table per scenario, then what to look at.
//!
//! Neighbours: the command line prints what comes from here. The text depends on the record alone (no times, no width
//! of a terminal), so that it can be held against a snapshot.

mod progress;

pub use progress::{Progress, ProgressKind};

use crate::{cost, evidence, shown, timing};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;
use std::io::{self, Write};

/// Columns that sentences are wrapped at; tables of the known metrics fit into it as well.
const WIDTH: usize = 100;

/// How a text is dressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// With ANSI colours. Verdicts carry a sign either way.
    pub colour: bool,
}

impl Style {
    fn paint(self, code: &str, text: &str) -> String {
        if self.colour { format!("\u{1b}[{code}m{text}\u{1b}[0m") } else { text.to_owned() }
    }

    fn verdict(self, verdict: Verdict, text: &str) -> String {
        let code = match verdict {
            Verdict::Pass => "32",
            Verdict::Fail => "1;31",
            Verdict::Inconclusive => "33",
        };
        self.paint(code, text)
    }
}

/// The whole run: scenarios in the order in which they were played, the counts, the verdict, and the trace to look at
/// for everything that did not pass.
pub fn table(record: &RunRecord, style: Style) -> String {
    let mut text = String::new();
    for scenario in &record.scenarios {
        heading(&mut text, scenario, style);
        expectations(&mut text, scenario, style);
        text.push('\n');
    }
    summary(&mut text, record, style);
    text
}

/// Writes `text` and a line's end to `out`.
///
/// # Errors
/// What the system says; a closed pipe is not an error, whoever closed it has read enough.
pub fn print(text: &str, out: &mut dyn Write) -> io::Result<()> {
    match writeln!(out, "{}", text.trim_end()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

fn heading(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    let verdict = format!("{} {}", shown::sign(scenario.verdict), scenario.verdict);
    let trials = shown::count(scenario.trials.len(), "trial");
    let file = style.paint("1", &scenario.file);
    let verdict = style.verdict(scenario.verdict, &verdict);
    // Writing into a String cannot fail.
    let _ = writeln!(text, "{verdict}  {file}  (law {}, {trials})", scenario.law);
    wrapped(text, "  ", "  ", &scenario.title);
    if let Some(sentence) = timing::sentence(scenario) {
        wrapped(text, "  ", "  ", &sentence);
    }
}

fn expectations(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    let rows: Vec<[String; 6]> = scenario
        .expectations
        .iter()
        .enumerate()
        .map(|(index, expectation)| {
            let dash = || "–".to_owned();
            [
                evidence::key(scenario, index),
                format!("{} {}", shown::sign(expectation.verdict), shown::verdict(expectation)),
                shown::found(expectation).unwrap_or_else(dash),
                shown::limit(expectation),
                shown::interval(expectation).unwrap_or_else(dash),
                expectation.paper.map_or_else(dash, shown::number),
            ]
        })
        .collect();
    if rows.is_empty() {
        text.push_str("  nothing was judged\n");
        return;
    }
    let header = ["metric", "verdict", "value", "limit", "interval", "paper"].map(str::to_owned);
    let widths: [usize; 6] = std::array::from_fn(|column| {
        let cells = rows.iter().chain([&header]).filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    });
    let line = |row: &[String; 6]| {
        let padded = row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}"));
        format!("  {}", padded.collect::<Vec<_>>().join("  "))
    };
    text.push('\n');
    let _ = writeln!(text, "{}", style.paint("2", line(&header).trim_end()));
    for (row, expectation) in rows.iter().zip(&scenario.expectations) {
        let [_, verdict, ..] = row;
        let plain = line(row);
        let coloured = plain.trim_end().replacen(verdict, &style.verdict(expectation.verdict, verdict), 1);
        let _ = writeln!(text, "{coloured}");
    }
    for (index, expectation) in scenario.expectations.iter().enumerate() {
        if let Some(reason) = &expectation.reason {
            wrapped(text, "  ↳ ", "    ", &format!("{}: {reason}", evidence::key(scenario, index)));
        }
    }
}

fn summary(text: &mut String, record: &RunRecord, style: Style) {
    for (one, counts) in
        [("scenario", shown::Counts::of_scenarios(record)), ("expectation", shown::Counts::of_expectations(record))]
    {
        let _ = writeln!(text, "{}: {counts}", shown::count(counts.total(), one));
    }
    for trend in &record.cost {
        let _ = writeln!(text, "instructions per step: {}", cost::worst(trend));
        if let Some(change) = cost::change(trend) {
            wrapped(text, "  ↳ ", "    ", &change);
        }
    }
    if let Some(changed) = shown::overrides(record) {
        wrapped(text, "", "  ", &format!("not as the scenarios have it: {changed}"));
    }
    if !record.complete {
        text.push_str("the run was not finished\n");
    }
    let verdict = format!("{} {}", shown::sign(record.verdict), record.verdict);
    let _ = writeln!(text, "verdict: {}", style.verdict(record.verdict, &verdict));
    let open = evidence::open_points(record);
    if !open.is_empty() {
        text.push_str("\nlook at:\n");
    }
    for (scenario, index) in open {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let sign = style.verdict(expectation.verdict, shown::sign(expectation.verdict));
        let trace = evidence::trial(scenario, index).map_or("no trace", |trial| trial.trace.as_str());
        let _ = writeln!(text, "  {sign} {}: {}  {trace}", scenario.file, evidence::key(scenario, index));
    }
}

/// Appends `sentence` in lines of at most [`WIDTH`] columns where its words allow.
fn wrapped(text: &mut String, first: &str, further: &str, sentence: &str) {
    let mut line = first.to_owned();
    let mut empty = true;
    for word in sentence.split_whitespace() {
        if !empty && line.chars().count() + 1 + word.chars().count() > WIDTH {
            let _ = writeln!(text, "{line}");
            further.clone_into(&mut line);
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line.push_str(word);
        empty = false;
    }
    if !empty {
        let _ = writeln!(text, "{line}");
    }
}
