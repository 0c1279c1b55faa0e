//! Writes a run for a terminal. The text does not depend on the terminal's width.

mod progress;

pub use progress::{Progress, ProgressKind};

use super::escape::printable;
use super::table::Table;
use super::{cost, timing};
use crate::{format, record_queries};
use platebench_record::{RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;
use std::io::{self, Write};

const WIDTH: usize = 100;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// ANSI colours. Verdicts have a sign in any case.
    pub colour: bool,
}

impl Style {
    fn paint(self, code: &str, text: &str) -> String {
        if self.colour { format!("\u{1b}[{code}m{text}\u{1b}[0m") } else { text.to_owned() }
    }

    fn paint_verdict(self, verdict: Verdict, text: &str) -> String {
        let code = match verdict {
            Verdict::Pass => "32",
            Verdict::Fail => "1;31",
            Verdict::Inconclusive => "33",
        };
        self.paint(code, text)
    }
}

pub fn run_table(record: &RunRecord, style: Style) -> String {
    let mut text = String::new();
    for scenario in &record.scenarios {
        write_heading(&mut text, scenario, style);
        write_expectations(&mut text, scenario, style);
        text.push('\n');
    }
    write_summary(&mut text, record, style);
    text
}

/// A closed pipe is no error.
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
    // All other models are exact.
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
            printable(&expectation.name).into_owned(),
            format!("{} {}", format::sign(expectation.verdict), format::verdict(expectation)),
            format::value_or_not_reached(expectation).unwrap_or_else(dash),
            format::limit(expectation),
            format::interval(expectation).unwrap_or_else(dash),
            format::windows(expectation).unwrap_or_else(dash),
        ];
        row.extend(has_paper.then(|| expectation.paper.map_or_else(dash, format::number)));
        table.rows.push(row);
    }
    let lines = table.lines();
    let mut lines = lines.iter();
    let header = lines.next().map_or("", String::as_str);
    let _ = writeln!(text, "\n{}", style.paint("2", &format!("  {header}")));
    for (line, (row, expectation)) in lines.zip(table.rows.iter().zip(&scenario.expectations)) {
        let verdict = row.get(1).map_or("", String::as_str);
        let coloured = line.replacen(verdict, &style.paint_verdict(expectation.verdict, verdict), 1);
        let _ = writeln!(text, "  {coloured}");
    }
    for expectation in &scenario.expectations {
        if let Some(reason) = &expectation.reason {
            write_wrapped(text, "  ↳ ", "    ", &format!("{}: {reason}", expectation.name));
        }
    }
}

fn write_summary(text: &mut String, record: &RunRecord, style: Style) {
    for scenario in &record.not_applicable {
        write_wrapped(text, "not applicable: ", "  ", &format!("{}: {}", scenario.file, scenario.reason));
    }
    for (name, counts) in [
        ("scenario", format::VerdictCounts::of_scenarios(record)),
        ("expectation", format::VerdictCounts::of_expectations(record)),
    ] {
        let _ = writeln!(text, "{}: {counts}", format::count(counts.total(), name));
    }
    for trend in &record.cost {
        let _ = writeln!(text, "instructions per step: {}", cost::format_worst(trend));
        if let Some(change) = cost::describe_change(trend) {
            write_wrapped(text, "  ↳ ", "    ", &change);
        }
    }
    if let Some(overrides) = format::overrides(record) {
        write_wrapped(text, "", "  ", &format!("overridden: {overrides}"));
    }
    if !record.complete {
        text.push_str("the run was not finished\n");
    }
    let verdict = format!("{} {}", format::sign(record.verdict), record.verdict);
    let _ = writeln!(text, "verdict: {}", style.paint_verdict(record.verdict, &verdict));
    let not_passed = record_queries::expectations_not_passed(record);
    if !not_passed.is_empty() {
        text.push_str("\nnot passed:\n");
    }
    for (scenario, index) in not_passed {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let sign = style.paint_verdict(expectation.verdict, format::sign(expectation.verdict));
        let trace = record_queries::trial_to_inspect(scenario, index).map_or("no trace", |trial| trial.trace.as_str());
        let (file, name) = (printable(&scenario.file), printable(&expectation.name));
        let _ = writeln!(text, "  {sign} {file}: {name}  {}", printable(trace));
    }
}

/// Lines of at most [`WIDTH`] columns, longer only for a longer word.
fn write_wrapped(text: &mut String, first: &str, further: &str, sentence: &str) {
    let mut line = first.to_owned();
    let mut empty = true;
    for word in printable(sentence).split_whitespace() {
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
