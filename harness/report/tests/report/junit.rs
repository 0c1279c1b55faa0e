//! `junit.xml`.

use crate::made;
use platebench_report::junit;
use platebench_verdict::{RunRecord, Verdict};
use quick_xml::events::Event;
use quick_xml::reader::Reader;
use rstest::rstest;
use std::collections::BTreeMap;

fn written(record: &RunRecord) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    junit::write(record, &path).unwrap();
    std::fs::read_to_string(path).unwrap()
}

/// How often each element occurs in a well-formed document.
fn elements(text: &str) -> BTreeMap<String, usize> {
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
fn a_case_per_expectation_and_nothing_inconclusive_is_green() {
    let text = written(&made::mixed());
    let counts = elements(&text);
    assert_eq!(counts["testsuite"], 3);
    assert_eq!(counts["testcase"], 10);
    assert_eq!(counts["failure"], 2);
    assert_eq!(counts["error"], 4);
    assert!(!counts.contains_key("skipped"));
    assert!(text.contains(r#"tests="10" failures="2" errors="4""#), "{text}");
    assert!(text.contains(r#"name="settling_time_ms ≤ 2" classname="paper/fig13-closed-loop.toml""#), "{text}");
    assert!(text.contains(r#"name="settling_time_ms[2] ≤ 2""#), "{text}");
    assert!(text.contains(r#"type="inconclusive: infeasible""#), "{text}");
    for line in [
        "requirement: ACC-1",
        "value: 1.94931",
        "limit: ≤ 2",
        "interval: 0 0.031",
        "cause: evidence",
        "paper: 5",
        "seed: 8",
        "trace: traces/paper/fig13-open-loop/001.csv",
    ] {
        assert!(text.lines().any(|found| found.ends_with(line)), "{line} in {text}");
    }
    let requirement = r#"<property name="requirement.settling_time_ms" value="ACC-1"/>"#;
    assert!(text.contains(requirement), "{requirement} in {text}");
}

#[rstest]
#[case::cut_short(|record: &mut RunRecord| record.complete = false)]
#[case::nothing(|record: &mut RunRecord| record.scenarios.clear())]
#[case::nothing_judged(|record: &mut RunRecord| {
    record.scenarios[0].expectations.clear();
    record.scenarios[0].verdict = Verdict::Inconclusive;
})]
#[case::run_in_doubt(|record: &mut RunRecord| record.verdict = Verdict::Inconclusive)]
fn what_did_not_pass_without_an_expectation_is_an_error(#[case] bend: fn(&mut RunRecord)) {
    let mut record = made::mixed();
    record.scenarios.truncate(1);
    record.verdict = Verdict::Pass;
    assert!(!elements(&written(&record)).contains_key("error"));
    bend(&mut record);
    assert_eq!(elements(&written(&record))["error"], 1);
}

#[test]
fn markup_in_titles_and_reasons_is_text() {
    let mut record = made::mixed();
    record.scenarios[1].title = r#"<script>alert("a & b")</script>"#.to_owned();
    record.scenarios[1].expectations[0].reason = Some("1 < 2 & \"3\" > \u{0}2".to_owned());
    let text = written(&record);
    assert_eq!(elements(&text)["testcase"], 10);
    assert!(!text.contains("<script"));
}

const PYTHON: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/test-readers/bin/python");
/// The schema that Jenkins checks with, MIT licence; from pytest's sources, which hold their own files against it.
const SCHEMA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/report/junit-10.xsd");
const VALIDATE: &str = "\
import sys
from lxml import etree
schema = etree.XMLSchema(etree.parse(sys.argv[1]))
schema.validate(etree.parse(sys.argv[2]))
print(schema.error_log)";

/// What the schema has against a text; `None`, said aloud, where nobody can tell, unless somebody has to.
fn against_schema(text: &str) -> Option<String> {
    if !std::path::Path::new(PYTHON).exists() {
        let all = std::env::var("PLATEBENCH_REQUIRE_ALL").is_ok_and(|value| value == "1");
        assert!(!all, "no lxml at {PYTHON} and PLATEBENCH_REQUIRE_ALL=1: ci/install-test-tools");
        eprintln!("NOT TESTED: no lxml at {PYTHON} (ci/install-test-tools)");
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
fn it_keeps_to_the_schema() {
    let mut cut_short = made::mixed();
    cut_short.complete = false;
    cut_short.scenarios[0].expectations.clear();
    cut_short.scenarios[1].title = "1 < 2 \u{1}".to_owned();
    for record in [made::mixed(), cut_short, made::run(Vec::new())] {
        let text = written(&record);
        let Some(found) = against_schema(&text) else { return };
        assert_eq!(found, "", "{text}");
    }
    let bent = written(&made::mixed()).replacen("<system-out>", "<properties/><system-out>", 1);
    assert!(against_schema(&bent).unwrap().contains("properties"), "the schema is looked at");
}
