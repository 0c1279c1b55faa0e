//! TAP 14, the Test Anything Protocol: a subtest per scenario, a test point per expectation.
//!
//! What is inconclusive is `not ok`, and says so in the block below it: the protocol's `SKIP` and `TODO` count as
//! passed. A run that was not finished ends in `Bail out!`.

use crate::error::ReportError;
use crate::{evidence, shown};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

/// Writes the run as TAP to `path`, replacing what is there.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    fs::write(path, text(record)).map_err(ReportError::io(path))
}

/// The run as TAP.
pub fn text(record: &RunRecord) -> String {
    // Beside the scenarios there is a point for the whole run where that did not pass and no scenario says so.
    let doubt = evidence::doubt(record);
    let mut text = format!("TAP version 14\n1..{}\n", record.scenarios.len() + usize::from(doubt.is_some()));
    for (number, scenario) in (1..).zip(&record.scenarios) {
        subtest(&mut text, scenario);
        point(&mut text, "", scenario.verdict, number, &scenario.file);
    }
    if let Some(doubt) = doubt {
        point(&mut text, "", Verdict::Inconclusive, record.scenarios.len() + 1, "the whole run");
        block(&mut text, "", &[("verdict", json!(Verdict::Inconclusive.name())), ("message", json!(doubt))]);
    }
    if !record.complete {
        text += "Bail out! the run was not finished\n";
    }
    text
}

fn subtest(text: &mut String, scenario: &ScenarioRecord) {
    const INDENT: &str = "    ";
    let doubt = evidence::doubt_of(scenario);
    let points = scenario.expectations.len() + usize::from(doubt.is_some());
    let _ = writeln!(text, "# Subtest: {}\n{INDENT}1..{points}", escaped(&scenario.file));
    for (index, expectation) in scenario.expectations.iter().enumerate() {
        let name = format!("{} {}", evidence::key(scenario, index), shown::limit(expectation));
        point(text, INDENT, expectation.verdict, index + 1, &name);
        if expectation.verdict == Verdict::Pass {
            continue;
        }
        let trace = evidence::trial(scenario, index).map(|trial| trial.trace.clone());
        let says = [
            ("verdict", json!(expectation.verdict.name())),
            ("cause", json!(expectation.cause)),
            ("message", json!(expectation.reason)),
            ("value", json!(expectation.value)),
            ("requirement", json!(expectation.requirement)),
            ("trace", json!(trace)),
        ];
        block(text, INDENT, &says);
    }
    if let Some(doubt) = doubt {
        point(text, INDENT, Verdict::Inconclusive, points, "the whole scenario");
        block(text, INDENT, &[("verdict", json!(Verdict::Inconclusive.name())), ("message", json!(doubt))]);
    }
}

fn point(text: &mut String, indent: &str, verdict: Verdict, number: usize, name: &str) {
    let ok = if verdict == Verdict::Pass { "ok" } else { "not ok" };
    let _ = writeln!(text, "{indent}{ok} {number} - {}", escaped(name));
}

/// A block of YAML; every value as JSON, which is YAML in a line.
fn block(text: &mut String, indent: &str, says: &[(&str, Value)]) {
    let _ = writeln!(text, "{indent}  ---");
    for (name, value) in says.iter().filter(|(_, value)| !value.is_null()) {
        let _ = writeln!(text, "{indent}  {name}: {value}");
    }
    let _ = writeln!(text, "{indent}  ...");
}

/// A description: on one line, and nothing in it is a directive.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('#', "\\#").replace(['\n', '\r'], " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_in_a_name_is_a_directive() {
        assert_eq!(escaped("a # SKIP b\\\nok 1"), "a \\# SKIP b\\\\ ok 1");
    }
}
