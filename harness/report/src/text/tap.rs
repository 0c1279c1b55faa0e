//! Writes TAP: a subtest per scenario, a test point per expectation. Readers of version 13 ignore
//! subtests. Inconclusive is `not ok`, because readers count `SKIP` and `TODO` as passed. `SKIP`
//! marks scenarios and expectations that are not applicable.

use crate::error::ReportError;
use crate::escape::tap_description;
use crate::{format, record_queries};
use platebench_model::record::{ExpectationRecord, RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::write_named_by_user;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::Path;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TapVersion {
    V13,
    V14,
}

pub fn write(record: &RunRecord, version: TapVersion, path: &Path) -> Result<(), ReportError> {
    Ok(write_named_by_user(path, text(record, version))?)
}

pub fn text(record: &RunRecord, version: TapVersion) -> String {
    let version = match version {
        TapVersion::V13 => 13,
        TapVersion::V14 => 14,
    };
    let reason = record_queries::run_inconclusive_reason(record);
    let listed = record.scenarios.len() + record.not_applicable.len();
    let mut text = format!("TAP version {version}\n1..{}\n", listed + usize::from(reason.is_some()));
    for (number, scenario) in (1..).zip(&record.scenarios) {
        write_subtest(&mut text, scenario);
        write_test_point(&mut text, "", scenario.verdict, number, &scenario.file);
    }
    for (number, scenario) in (record.scenarios.len() + 1..).zip(&record.not_applicable) {
        if record.overrides.require_all {
            write_not_passed(&mut text, "", Verdict::Fail, number, &scenario.file, &format::not_applicable(scenario));
        } else {
            write_skipped(&mut text, "", number, &scenario.file, &scenario.reason);
        }
    }
    if let Some(reason) = reason {
        write_not_passed(&mut text, "", Verdict::Inconclusive, listed + 1, "the whole run", reason);
    }
    if !record.complete {
        text += "Bail out! the run was not finished\n";
    }
    text
}

fn write_subtest(text: &mut String, scenario: &ScenarioRecord) {
    const INDENT: &str = "    ";
    let reason = record_queries::scenario_inconclusive_reason(scenario);
    let listed = scenario.expectations.len() + scenario.not_applicable.len();
    let points = listed + usize::from(reason.is_some());
    let _ = writeln!(text, "# Subtest: {}\n{INDENT}1..{points}", tap_description(&scenario.file));
    for (index, expectation) in scenario.expectations.iter().enumerate() {
        let name = format!("{} {}", expectation.name, format::limit(expectation));
        write_test_point(text, INDENT, expectation.verdict, index + 1, &name);
        if expectation.verdict != Verdict::Pass {
            write_yaml_block(text, INDENT, &diagnostics(scenario, index, expectation));
        }
    }
    for (number, skipped) in (scenario.expectations.len() + 1..).zip(&scenario.not_applicable) {
        write_skipped(text, INDENT, number, &skipped.name, &skipped.reason);
    }
    if let Some(reason) = reason {
        write_not_passed(text, INDENT, Verdict::Inconclusive, points, "the whole scenario", reason);
    }
}

fn diagnostics(scenario: &ScenarioRecord, index: usize, expectation: &ExpectationRecord) -> [(&'static str, Value); 6] {
    let trace = record_queries::trial_to_inspect(scenario, index).map(|trial| trial.trace.clone());
    [
        ("verdict", json!(expectation.verdict.name())),
        ("cause", json!(expectation.cause)),
        ("message", json!(expectation.reason.as_ref().map(ToString::to_string))),
        ("value", json!(expectation.value)),
        ("requirement", json!(expectation.requirement)),
        ("trace", json!(trace)),
    ]
}

fn write_not_passed(text: &mut String, indent: &str, verdict: Verdict, number: usize, name: &str, reason: &str) {
    write_test_point(text, indent, verdict, number, name);
    write_yaml_block(text, indent, &[("verdict", json!(verdict.name())), ("message", json!(reason))]);
}

fn write_skipped(text: &mut String, indent: &str, number: usize, name: &str, reason: &str) {
    let (name, reason) = (tap_description(name), tap_description(reason));
    let _ = writeln!(text, "{indent}ok {number} - {name} # SKIP not applicable: {reason}");
}

fn write_test_point(text: &mut String, indent: &str, verdict: Verdict, number: usize, name: &str) {
    let ok = if verdict == Verdict::Pass { "ok" } else { "not ok" };
    let _ = writeln!(text, "{indent}{ok} {number} - {}", tap_description(name));
}

/// Every value is JSON, which is YAML in one line.
fn write_yaml_block(text: &mut String, indent: &str, entries: &[(&str, Value)]) {
    let _ = writeln!(text, "{indent}  ---");
    for (name, value) in entries.iter().filter(|(_, value)| !value.is_null()) {
        let _ = writeln!(text, "{indent}  {name}: {}", crate::escape::json_line(value));
    }
    let _ = writeln!(text, "{indent}  ...");
}
