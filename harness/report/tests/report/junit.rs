//! Tests `junit.xml`.

use crate::fixtures;
use platebench_model::record::{Limit, MissingValue, Reason, RunRecord, TrialFinding, Verdict};
use platebench_report::junit;
use quick_xml::events::Event;
use quick_xml::reader::Reader;
use rstest::rstest;
use std::collections::BTreeMap;

fn write_junit(record: &RunRecord) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    junit::write(record, &path).unwrap();
    std::fs::read_to_string(path).unwrap().replace(&folder.path().display().to_string(), "runs/1")
}

fn count_elements(text: &str) -> BTreeMap<String, usize> {
    let mut reader = Reader::from_str(text);
    reader.config_mut().check_end_names = true;
    let mut counts = BTreeMap::new();
    let mut depth = 0;
    loop {
        match reader.read_event().unwrap() {
            Event::Start(element) => {
                depth += 1;
                *counts.entry(String::from_utf8(element.name().0.to_vec()).unwrap()).or_default() += 1;
            }
            Event::Empty(element) => {
                *counts.entry(String::from_utf8(element.name().0.to_vec()).unwrap()).or_default() += 1;
            }
            Event::End(_) => depth -= 1,
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(depth, 0);
    counts
}

#[test]
fn writes_a_case_per_expectation() {
    let text = write_junit(&fixtures::mixed_run());
    let counts = count_elements(&text);
    assert_eq!(["testsuite", "testcase", "failure", "error", "skipped"].map(|name| counts[name]), [4, 11, 2, 4, 1]);
    insta::assert_snapshot!(text);
}

#[test]
fn a_changed_limit_changes_no_name() {
    let names = |record: &RunRecord| {
        let text = write_junit(record);
        let names: Vec<String> = text.lines().filter(|line| line.contains("<testcase")).map(str::to_owned).collect();
        names
    };
    let mut record = fixtures::mixed_run();
    let before = names(&record);
    for expectation in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.expectations) {
        expectation.limit = Limit::AtMost(77.0);
    }
    assert_eq!(names(&record), before);
    let first = r#"<testcase name="settling_time_ms" classname="paper/fig13-closed-loop""#;
    assert!(before[0].trim().starts_with(first), "{}", before[0]);
}

#[test]
fn files_have_different_class_names() {
    let scenarios = ["a_b.toml", "a.b.toml", "b.c_d.toml", "b_c.d.toml", "e.f.toml"].map(|file| {
        let mut scenario = fixtures::closed_loop();
        file.clone_into(&mut scenario.file);
        scenario
    });
    let text = write_junit(&fixtures::run(scenarios.to_vec()));
    let classes: Vec<_> = text.split("classname=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    assert_eq!(classes, ["a_b", "a_b 2", "b_c_d", "b_c_d 2", "e_f"]);
}

#[rstest]
#[case::cut_short(|record: &mut RunRecord| record.complete = false)]
#[case::nothing(|record: &mut RunRecord| record.scenarios.clear())]
#[case::nothing_judged(|record: &mut RunRecord| {
    record.scenarios[0].expectations.clear();
    record.scenarios[0].verdict = Verdict::Inconclusive;
})]
#[case::run_in_doubt(|record: &mut RunRecord| record.verdict = Verdict::Inconclusive)]
fn a_run_that_did_not_pass_has_an_error(#[case] bend: fn(&mut RunRecord)) {
    let mut record = fixtures::mixed_run();
    record.scenarios.truncate(1);
    record.verdict = Verdict::Pass;
    assert!(!count_elements(&write_junit(&record)).contains_key("error"));
    bend(&mut record);
    assert_eq!(count_elements(&write_junit(&record))["error"], 1);
}

#[test]
fn markup_in_titles_and_reasons_is_text() {
    let mut record = fixtures::mixed_run();
    record.scenarios[1].title = r#"<script>alert("a & b")</script>"#.to_owned();
    record.scenarios[1].expectations[0].reason = Some(Reason::Trial {
        trial: 0,
        divergence: None,
        finding: TrialFinding::Missing(MissingValue::NotRunning),
        ended: Some("1 < 2 & \"3\" > \u{0}2".to_owned()),
        stopped: None,
    });
    let text = write_junit(&record);
    assert_eq!(count_elements(&text)["testcase"], 11);
    assert!(!text.contains("<script"));
}

const PYTHON: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/test-readers/bin/python");
/// Schema from pytest's sources, MIT licence.
const SCHEMA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/report/junit-10.xsd");
const VALIDATE: &str = "\
import sys
from lxml import etree
schema = etree.XMLSchema(etree.parse(sys.argv[1]))
schema.validate(etree.parse(sys.argv[2]))
print(schema.error_log)";

/// Prints a message and returns `None` if the validator is neither installed nor required.
fn schema_errors(text: &str) -> Option<String> {
    if !std::path::Path::new(PYTHON).exists() {
        platebench_test_kit::skip_without(&format!("lxml at {PYTHON}"));
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    std::fs::write(&path, text).unwrap();
    let output = std::process::Command::new(PYTHON).args(["-c", VALIDATE, SCHEMA]).arg(&path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap().trim().to_owned())
}

#[test]
fn follows_the_schema() {
    let mut cut_short = fixtures::mixed_run();
    cut_short.complete = false;
    cut_short.scenarios[0].expectations.clear();
    cut_short.scenarios[1].title = "1 < 2 \u{1}".to_owned();
    for record in [fixtures::mixed_run(), cut_short, fixtures::run(Vec::new())] {
        let text = write_junit(&record);
        let Some(found) = schema_errors(&text) else { return };
        assert_eq!(found, "", "{text}");
    }
    let bent = write_junit(&fixtures::mixed_run()).replacen("<system-out>", "<properties/><system-out>", 1);
    assert!(schema_errors(&bent).unwrap().contains("properties"), "the schema is checked");
}
