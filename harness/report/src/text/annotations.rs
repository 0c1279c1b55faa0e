//! Writes workflow commands of GitHub Actions. A failure is an `error`, inconclusive is a
//! `warning`. Failures come first, because GitHub shows ten annotations of a kind per step.

use crate::escape::{workflow_message, workflow_property};
use crate::{format, record_queries};
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;

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
        let value = format::value(expectation).unwrap_or_else(|| "no value".to_owned());
        let mut message = format!("{} {}, measured {value}", expectation.name, format::limit(expectation));
        if let Some(requirement) = &expectation.requirement {
            let _ = write!(message, ", requirement {requirement}");
        }
        if let Some(reason) = &expectation.reason {
            let _ = write!(message, "\n{reason}");
        }
        text += &workflow_command(expectation.verdict, location(scenario, Some(index)), &title, &message);
    }
    for scenario in &record.scenarios {
        if let Some(reason) = record_queries::scenario_inconclusive_reason(scenario) {
            text += &workflow_command(scenario.verdict, location(scenario, None), &scenario.file, reason);
        }
    }
    if let Some(reason) = record_queries::run_inconclusive_reason(record) {
        text += &workflow_command(record.verdict, None, "platebench", reason);
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
