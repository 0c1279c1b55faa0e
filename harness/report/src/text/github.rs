//! Writes a run for GitHub and for code review: workflow commands, and one page of Markdown.
//!
//! A failure is an `error`, inconclusive is a `warning`. Failures come first, because GitHub shows
//! ten annotations of a kind per step. GitHub rejects a summary above 1 MiB, so a table has at most
//! `MAX_ROWS` rows.

use crate::document::Table;
use crate::error::ReportError;
use crate::escape::{markdown_cell, workflow_message, workflow_property};
use crate::record_queries::OwnVerdict;
use crate::{format, record_queries};
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict};
use platebench_model::scenario::NotApplicableExpectation;
use platebench_model::trace::{AtPath, write_named_by_user};
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
    let level = if verdict == Verdict::Fail { "error" } else { "warning" };
    let location = location.map_or_else(String::new, |SourceLocation { file, line }| {
        format!("file={},line={line},", workflow_property(&file))
    });
    format!("::{level} {location}title={}::{}\n", workflow_property(title), workflow_message(message))
}

const MAX_ROWS: usize = 200;

pub fn write_markdown(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    Ok(write_named_by_user(path, render_page(record))?)
}

#[expect(clippy::disallowed_methods, reason = "GitHub names this file, and each step appends to it")]
pub fn append_markdown(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    let file = fs::OpenOptions::new().append(true).create(true).open(path);
    Ok(file.and_then(|mut file| file.write_all(format!("{}\n", render_page(record)).as_bytes())).at(path)?)
}

pub fn render_page(record: &RunRecord) -> String {
    let mut text = String::new();
    let counts = format::VerdictCounts::of_expectations(record);
    let _ = writeln!(text, "## {} platebench: {}\n", format::sign(record.verdict), record.verdict);
    let _ = writeln!(text, "Tested: {}.\n", markdown_cell(&format::tested(record)));
    let scenarios = format::count(record.scenarios.len(), "scenario");
    let trials = format::count(record.scenarios.iter().map(|scenario| scenario.trials.len()).sum(), "trial");
    let started = markdown_cell(&record.started);
    let _ = writeln!(text, "{scenarios}, {trials}; expectations: {counts}. Started {started}.\n");
    if let Some(scripts) = record_queries::scripts_not_played(record) {
        let _ = writeln!(text, "Not played: {}.\n", markdown_cell(&scripts));
    }
    if let Some(overrides) = format::overrides(record) {
        let _ = writeln!(text, "Overridden: {}.\n", markdown_cell(&overrides));
    }
    if let Some(OwnVerdict { verdict, reason }) = record_queries::own_verdict_of_run(record) {
        let _ = writeln!(text, "**{verdict}: {reason}**\n");
    }
    if record.unsafe_end().is_some() && record.may_have_amplifier() {
        text += "**Check the amplifier before you touch the plate.**\n\n";
    }
    let missed = record_queries::required_not_applicable(record).len();
    let not_passed = record_queries::expectations_not_passed(record).len() + missed;
    if not_passed > 0 {
        write_table(&mut text, &not_passed_table(record), not_passed);
    }
    write_table(&mut text, &scenarios_table(record), record.scenarios.len());
    let rows = not_applicable_rows(record);
    if !rows.is_empty() {
        let mut table = Table::new(["Not applicable", "Because"]);
        table.extend(rows.iter().take(MAX_ROWS).cloned());
        write_table(&mut text, &table, rows.len());
    }
    text
}

fn not_passed_table(record: &RunRecord) -> Table {
    let mut table = Table::new(["", "Scenario", "Expected", "Measured", "Requirement", "Reason", "Trace"]);
    for scenario in record_queries::required_not_applicable(record).iter().take(MAX_ROWS) {
        let reason = format!("{}: {}", Verdict::Fail, format::not_applicable(scenario));
        let row = [format::sign(Verdict::Fail), &scenario.file, "", "", "", &reason, ""];
        table.push(row.map(str::to_owned).to_vec());
    }
    let further = MAX_ROWS.saturating_sub(table.rows.len());
    for (scenario, index) in record_queries::expectations_not_passed(record).into_iter().take(further) {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let verdict = format::verdict(expectation);
        let reason = expectation.reason.as_ref().map(|reason| format!("{verdict}: {reason}"));
        let trace = record_queries::trial_to_inspect(scenario, index).map(|trial| trial.trace.clone());
        table.push(vec![
            format::sign(expectation.verdict).to_owned(),
            scenario.file.clone(),
            format!("{} {}", expectation.name, format::limit(expectation)),
            format::value_or_not_reached(expectation).unwrap_or_else(|| "none".to_owned()),
            expectation.requirement.clone().unwrap_or_default(),
            reason.unwrap_or(verdict),
            trace.unwrap_or_default(),
        ]);
    }
    table
}

fn scenarios_table(record: &RunRecord) -> Table {
    let mut table = Table::new(["", "Scenario", "Verdict", "Law", "Trials", "Expectations"]);
    for scenario in record.scenarios.iter().take(MAX_ROWS) {
        let counts: format::VerdictCounts = scenario.expectations.iter().map(|found| found.verdict).collect();
        let reason = record_queries::own_verdict_of_scenario(scenario).map(|own| own.reason);
        table.push(vec![
            format::sign(scenario.verdict).to_owned(),
            scenario.file.clone(),
            scenario.verdict.to_string(),
            scenario.law.clone(),
            scenario.trials.len().to_string(),
            reason.unwrap_or_else(|| counts.to_string()),
        ]);
    }
    table
}

fn not_applicable_rows(record: &RunRecord) -> Vec<Vec<String>> {
    let unplayed = record_queries::skipped_scenarios(record).iter();
    let unplayed = unplayed.map(|scenario| vec![scenario.file.clone(), scenario.reason.clone()]);
    let played = record.scenarios.iter().flat_map(|scenario| {
        let row = |skipped: &NotApplicableExpectation| {
            vec![format!("{}: {}", scenario.file, skipped.name), skipped.reason.clone()]
        };
        scenario.not_applicable.iter().map(row)
    });
    unplayed.chain(played).collect()
}

/// Adds how many of `all` rows the table does not contain.
fn write_table(text: &mut String, table: &Table, all: usize) {
    *text += &table.markdown();
    if all > table.rows.len() {
        let _ = writeln!(text, "\n… and {} more.", all - table.rows.len());
    }
    text.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;

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
