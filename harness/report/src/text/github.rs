//! Writes a run or a comparison for GitHub and for code review: workflow commands, and one page of
//! Markdown.
//!
//! A failure is an `error`, inconclusive is a `warning`. Failures come first, because GitHub shows
//! ten annotations of a kind per step. GitHub rejects a summary above 1 MiB, so a table has at most
//! `MAX_ROWS` rows.

use crate::comparison::{ScenarioComparison, changed_scenarios, changes_table};
use crate::record_queries::OwnVerdict;
use crate::{format, record_queries};
use platebench_document::{Block, Document, Table};
use platebench_model::printable::{printable, printable_lines};
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict, VerdictCounts};
use platebench_model::trace::{AtPath, FileError};
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SourceLocation {
    /// Relative to the repository, with `/`.
    pub file: String,
    /// Counted from 1.
    pub line: usize,
}

/// `location` returns the line of the expectation with the index or, for `None`, of the scenario.
pub fn workflow_commands(
    record: &RunRecord,
    location: &dyn Fn(&ScenarioRecord, Option<usize>) -> Option<SourceLocation>,
) -> String {
    let mut text = String::new();
    for (scenario, index) in record_queries::expectations_not_passed(record) {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let title = format!("{}: {}", scenario.file, format::verdict(expectation));
        let mut message = format::summary(expectation);
        if let Some(requirement) = &expectation.requirement {
            let _ = write!(message, ", requirement {requirement}");
        }
        if let Some(reason) = &expectation.reason {
            let _ = write!(message, "\n{reason}");
        }
        text += &workflow_command(expectation.verdict, location(scenario, Some(index)), &title, &message);
    }
    for scenario in record_queries::required_not_applicable(record) {
        text += &workflow_command(Verdict::Fail, None, &scenario.file, &format::not_applicable(scenario));
    }
    for scenario in &record.scenarios {
        if let Some(OwnVerdict { verdict, reason }) = record_queries::own_verdict_of_scenario(scenario) {
            text += &workflow_command(verdict, location(scenario, None), &scenario.file, &reason);
        }
    }
    if let Some(OwnVerdict { verdict, reason }) = record_queries::own_verdict_of_run(record) {
        text += &workflow_command(verdict, None, "platebench", &reason);
    }
    text
}

fn workflow_command(verdict: Verdict, location: Option<SourceLocation>, title: &str, message: &str) -> String {
    let level = match verdict {
        Verdict::Fail => "error",
        Verdict::Inconclusive => "warning",
        Verdict::Pass => "notice",
    };
    let location = location.map_or_else(String::new, |SourceLocation { file, line }| {
        format!("file={},line={line},", workflow_property(&file))
    });
    format!("::{level} {location}title={}::{}\n", workflow_property(title), workflow_message(message))
}

fn workflow_message(text: &str) -> String {
    printable_lines(text).replace('%', "%25").replace('\n', "%0A")
}

fn workflow_property(text: &str) -> String {
    printable(text).replace('%', "%25").replace(':', "%3A").replace(',', "%2C")
}

const MAX_ROWS: usize = 200;

#[expect(clippy::disallowed_methods, reason = "GitHub names this file, and each step appends to it")]
pub fn append_markdown(page: &str, path: &Path) -> Result<(), FileError> {
    let file = fs::OpenOptions::new().append(true).create(true).open(path);
    file.and_then(|mut file| file.write_all(format!("{page}\n").as_bytes())).at(path)
}

pub fn render_page(record: &RunRecord) -> String {
    let trials = format::count(record.scenarios.iter().map(|scenario| scenario.trials.len()).sum(), "trial");
    let (scenarios, started) = (format::count(record.scenarios.len(), "scenario"), &record.started);
    let counts = record.expectation_counts();
    let sentences = [
        Some(format!("Tested: {}.", format::tested(record))),
        Some(format!("{scenarios}, {trials}; expectations: {counts}. Started {started}.")),
        record_queries::scripts_not_played(record).map(|scripts| format!("Not played: {scripts}.")),
        format::overrides(record).map(|overrides| format!("Overridden: {overrides}.")),
    ];
    let mut blocks = vec![Block::heading(format!("{} platebench: {}", format::sign(record.verdict), record.verdict))];
    blocks.extend(sentences.into_iter().flatten().map(Block::Paragraph));
    let own = record_queries::own_verdict_of_run(record);
    blocks.extend(own.map(|OwnVerdict { verdict, reason }| Block::Verdict(verdict, reason)));
    if record.unsafe_end().is_some() && record.may_have_amplifier() {
        blocks.push(Block::heading("Check the amplifier before you touch the plate."));
    }
    let tables = [not_passed_table(record), scenarios_table(record), not_applicable_table(record)];
    blocks.extend(tables.into_iter().flat_map(table_blocks));
    markdown(blocks)
}

fn markdown(blocks: Vec<Block>) -> String {
    Document::new("", blocks).blocks_to_markdown().trim_start().to_owned()
}

/// No block for a table without rows.
fn table_blocks(mut table: Table) -> Vec<Block> {
    let further = table.rows.len().saturating_sub(MAX_ROWS);
    table.rows.truncate(MAX_ROWS);
    let further = (further > 0).then(|| Block::Paragraph(format!("… and {further} more.")));
    (!table.rows.is_empty()).then_some(Block::Table(table)).into_iter().chain(further).collect()
}

/// A comparison for a reviewer.
#[derive(Debug)]
pub struct ComparisonPage<'a> {
    pub heading: String,
    /// Numbers of scenarios, or why nothing was compared.
    pub reason: &'a str,
    pub comparisons: &'a [ScenarioComparison],
    /// Command that accepts the changes. `None` if the reference is no baseline.
    pub accept: Option<String>,
}

const MAX_PLOTS: usize = 10;

impl ComparisonPage<'_> {
    pub fn render(&self) -> String {
        let changed = changed_scenarios(self.comparisons);
        let mut blocks = vec![Block::heading(&self.heading), Block::paragraph(self.reason)];
        blocks.extend(table_blocks(changes_table(&changed)));
        if let Some(command) = self.accept.as_ref().filter(|_| !changed.is_empty()) {
            let intended = "If the changes are intended, accept them and commit the files that the command writes. It \
                            accepts scenarios that passed.";
            blocks.extend([Block::paragraph(intended), Block::lines([command.clone()])]);
        }
        for one in changed.into_iter().filter(|one| !one.plot.is_empty()).take(MAX_PLOTS) {
            blocks.extend(one.blocks());
            blocks.push(Block::lines(one.plot.iter().cloned()));
            blocks.extend(one.drawing.as_ref().map(|drawing| Block::File(drawing.display().to_string())));
        }
        markdown(blocks)
    }

    /// `location` returns the file of the reference of a scenario.
    pub fn workflow_commands(&self, location: &dyn Fn(&str) -> Option<SourceLocation>) -> String {
        let command = |one: &ScenarioComparison| {
            let accept = self.accept.iter().map(|command| format!("\nif this is intended: {command}"));
            let message = std::iter::once(one.summary()).chain(accept).collect::<String>();
            let title = format!("{}: the response changed", one.scenario);
            workflow_command(one.comparison.verdict, location(&one.scenario), &title, &message)
        };
        changed_scenarios(self.comparisons).into_iter().map(command).collect()
    }
}

fn not_passed_table(record: &RunRecord) -> Table {
    let mut table = Table::new(["", "Scenario", "Expected", "Measured", "Requirement", "Reason", "Trace"]);
    for scenario in record_queries::required_not_applicable(record) {
        let reason = format!("{}: {}", Verdict::Fail, format::not_applicable(scenario));
        table.push([format::sign(Verdict::Fail), &scenario.file, "", "", "", &reason, ""]);
    }
    for (scenario, index) in record_queries::expectations_not_passed(record) {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let verdict = format::verdict(expectation);
        let reason = expectation.reason.as_ref().map(|reason| format!("{verdict}: {reason}"));
        table.push([
            format::sign(expectation.verdict),
            &scenario.file,
            &format!("{} {}", expectation.name, format::limit(expectation)),
            format::value_or_not_reached(expectation).as_deref().unwrap_or("none"),
            expectation.requirement.as_deref().unwrap_or_default(),
            &reason.unwrap_or(verdict),
            record_queries::trial_to_inspect(scenario, index).map_or("", |trial| &*trial.trace),
        ]);
    }
    table
}

fn scenarios_table(record: &RunRecord) -> Table {
    let mut table = Table::new(["", "Scenario", "Verdict", "Law", "Trials", "Expectations"]);
    table.extend(record.scenarios.iter().map(|scenario| {
        let counts: VerdictCounts = scenario.expectations.iter().map(|found| found.verdict).collect();
        let reason = record_queries::own_verdict_of_scenario(scenario).map(|own| own.reason);
        [
            format::sign(scenario.verdict).to_owned(),
            scenario.file.clone(),
            scenario.verdict.to_string(),
            scenario.law.clone(),
            scenario.trials.len().to_string(),
            reason.unwrap_or_else(|| counts.to_string()),
        ]
    }));
    table
}

fn not_applicable_table(record: &RunRecord) -> Table {
    let mut table = Table::new(["Not applicable", "Because"]);
    table.extend(record_queries::skipped_scenarios(record).iter().map(|scenario| [&*scenario.file, &scenario.reason]));
    for (scenario, skipped) in record_queries::skipped_expectations(record) {
        table.push([&*format!("{}: {}", scenario.file, skipped.name), &skipped.reason]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_hostile_text() {
        let hostile = "=1\u{1b}[2J\u{202e}\n::error::#|";
        assert_eq!(workflow_message(hostile), "=1\\u{1b}[2J\\u{202e}%0A::error::#|");
        assert_eq!(workflow_property(hostile), "=1\\u{1b}[2J\\u{202e}\\n%3A%3Aerror%3A%3A#|");
        assert_eq!([workflow_message, workflow_property].map(|escape| escape("µm ≤ 2 …")), ["µm ≤ 2 …"; 2]);
    }

    #[test]
    fn no_text_ends_a_command_or_begins_another() {
        let location = SourceLocation { file: "a,b:c%.toml".to_owned(), line: 7 };
        assert_eq!(
            workflow_command(Verdict::Fail, Some(location), "t: 1,2\n", "5 % off\r\n::error::x, y: z"),
            "::error file=a%2Cb%3Ac%25.toml,line=7,title=t%3A 1%2C2\\n::5 %25 off\\r%0A::error::x, y: z\n"
        );
        assert_eq!(workflow_command(Verdict::Inconclusive, None, "t", "m"), "::warning title=t::m\n");
    }
}
