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
    assert!(text.contains(r#"tests="10" skipped="0" failures="2" errors="4""#), "{text}");
    assert!(text.contains(r#"name="settling_time_ms ≤ 2" classname="paper/fig13-closed-loop.toml""#), "{text}");
    assert!(text.contains(r#"name="settling_time_ms[2] ≤ 2""#), "{text}");
    assert!(text.contains(r#"type="inconclusive: infeasible""#), "{text}");
    for property in [
        ("requirement", "ACC-1"),
        ("value", "1.94931"),
        ("limit", "≤ 2"),
        ("interval", "0 0.031"),
        ("cause", "evidence"),
        ("paper", "5"),
        ("seed", "8"),
        ("trace", "traces/paper/fig13-open-loop/001.csv"),
    ] {
        let wanted = format!(r#"<property name="{}" value="{}"/>"#, property.0, property.1);
        assert!(text.contains(&wanted), "{wanted} in {text}");
    }
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
