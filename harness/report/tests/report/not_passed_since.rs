//! Tests the sentence in `report.html` that dates a failure.

use crate::fixtures;
use crate::fixtures::open_loop;
use crate::page::write_page;
use platebench_model::record::{
    ExpectationRecord, Limit, MetricDefinition, RunRecord, ScenarioRecord, Statistic, Verdict,
};
use platebench_report::page;
use rstest::rstest;
use std::fs;
use std::path::PathBuf;

struct RunFolders(tempfile::TempDir);

impl RunFolders {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn write(&self, name: &str, started: &str, change: impl FnOnce(&mut RunRecord)) -> (RunRecord, PathBuf) {
        let mut record = fixtures::run(vec![open_loop()]);
        started.clone_into(&mut record.started);
        change(&mut record);
        let folder = self.0.path().join(name);
        fs::create_dir_all(&folder).unwrap();
        record.write(&folder).unwrap();
        (record, folder)
    }
}

fn set_passed(record: &mut RunRecord) {
    record.scenarios[0].expectations[0].verdict = Verdict::Pass;
}

fn not_passed_since((record, folder): &(RunRecord, PathBuf)) -> String {
    let path = folder.join(page::FILE);
    page::ReportPage::new(record, folder).with_earlier_runs().write(&path).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    text.split_once("<span class=\"since\">").unwrap().1.split_once("</span>").unwrap().0.to_owned()
}

#[test]
fn names_the_first_failed_and_the_last_passed_run() {
    let runs = RunFolders::new();
    let now = runs.write("now", "2026-03-05T00:00:00Z", |_| ());
    assert!(!write_page(&now.0, &now.1).contains("class=\"since\""), "without a search");
    assert_eq!(not_passed_since(&now), "First run of this scenario in this folder.");
    runs.write("later", "2026-03-06T00:00:00Z", set_passed);
    assert_eq!(not_passed_since(&now), "First run of this scenario in this folder.");
    runs.write("d", "2026-03-04T00:00:00Z", |_| ());
    assert_eq!(
        not_passed_since(&now),
        "Since d (2026-03-04T00:00:00Z) or before: no earlier run on <code>hosted</code> with <code>open-loop</code> \
         in this folder passed it."
    );
    runs.write("c", "2026-03-03T00:00:00Z", |_| ());
    runs.write("b", "2026-03-02T00:00:00Z", set_passed);
    runs.write("a", "2026-03-01T00:00:00Z", |_| ());
    let text = not_passed_since(&now);
    assert!(text.starts_with("Since c (2026-03-03T00:00:00Z), 2 runs ago. It last passed in b (2026-03-02"), "{text}");
    runs.write("d", "2026-03-04T00:00:00Z", set_passed);
    let text = not_passed_since(&now);
    assert!(
        text.starts_with("New in this run. It last passed in d (2026-03-04T00:00:00Z), with the same build"),
        "{text}"
    );
    fs::write(runs.0.path().join("d/run.json"), "damaged").unwrap();
    assert!(not_passed_since(&now).starts_with("Since c (2026-03-03T00:00:00Z), 1 run ago. It last passed in b"));
}

/// Of two failed scenarios, the one that passed before is listed first.
#[rstest]
#[case::none_is_new(None, "a.toml")]
#[case::the_second_is_new(Some(1), "b.toml")]
fn a_new_failure_comes_first(#[case] passed: Option<usize>, #[case] first: &str) {
    let two = |record: &mut RunRecord| {
        let named = |file: &str| ScenarioRecord { file: file.to_owned(), ..open_loop() };
        record.scenarios = vec![named("a.toml"), named("b.toml")];
    };
    let runs = RunFolders::new();
    let (record, folder) = runs.write("now", "2026-03-05T00:00:00Z", two);
    runs.write("before", "2026-03-04T00:00:00Z", |record| {
        two(record);
        if let Some(index) = passed {
            record.scenarios[index].expectations[0].verdict = Verdict::Pass;
        }
    });
    let path = folder.join(page::FILE);
    page::ReportPage::new(&record, &folder).with_earlier_runs().write(&path).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    let (_, open) = text.split_once("id=\"open\"").unwrap();
    let place = |file: &str| open.find(file).unwrap();
    let other = if first == "a.toml" { "b.toml" } else { "a.toml" };
    assert!(place(first) < place(other));
}

#[test]
fn compares_only_the_same_kind_of_rig_and_law() {
    const NONE: &str =
        "First run of this scenario on <code>emulated</code> with <code>open-loop</code> in this folder.";
    let runs = RunFolders::new();
    let rig = |record: &mut RunRecord, name: &str| name.clone_into(&mut record.rig.name);
    let now = runs.write("now", "2026-03-05T00:00:00Z", |record| rig(record, "emulated:mine.elf"));
    runs.write("another-rig", "2026-03-04T00:00:00Z", |record| {
        set_passed(record);
        rig(record, "serial:/dev/x");
    });
    assert_eq!(not_passed_since(&now), NONE);
    runs.write("another-law", "2026-03-03T00:00:00Z", |record| {
        set_passed(record);
        rig(record, "emulated");
        "dq-pi".clone_into(&mut record.scenarios[0].law);
    });
    assert_eq!(not_passed_since(&now), NONE);
    runs.write("failed", "2026-03-02T00:00:00Z", |record| rig(record, "emulated"));
    let text = not_passed_since(&now);
    assert!(
        text.starts_with("Since failed (2026-03-02T00:00:00Z) or before: no earlier run on <code>emulated</code>"),
        "{text}"
    );
    runs.write("passed", "2026-03-01T00:00:00Z", |record| {
        set_passed(record);
        rig(record, "emulated");
    });
    assert!(
        not_passed_since(&now)
            .contains("1 run ago. It last passed in passed (2026-03-01T00:00:00Z), with the same build")
    );
}

#[rstest]
#[case::same(|_: &mut ExpectationRecord| (), "")]
#[case::limit(|then: &mut ExpectationRecord| then.limit = Limit::AtMost(60.0), ", then with ≤ 60 ms")]
#[case::statistic(|then: &mut ExpectationRecord| then.statistic = Statistic::Mean, ", then with the mean of trials")]
#[case::band(|then: &mut ExpectationRecord| then.definition.band_percent = Some(2.0), ", then with a band of 2 %")]
#[case::from(|then: &mut ExpectationRecord| then.definition.from_ms = Some(40.0), ", then with from_ms = 40")]
#[case::signal(
    |then: &mut ExpectationRecord| then.definition.signal = Some("wd_um".to_owned()), ", then with signal wd_um"
)]
#[case::from_nowhere(|then: &mut ExpectationRecord| then.definition.from_ms = None, ", then with no from_ms")]
#[case::silent(|then: &mut ExpectationRecord| then.definition = MetricDefinition::default(), "")]
fn names_how_the_earlier_expectation_differed(#[case] change: fn(&mut ExpectationRecord), #[case] expected: &str) {
    let runs = RunFolders::new();
    let defined = |record: &mut RunRecord| {
        record.scenarios[0].expectations[0].definition = MetricDefinition {
            from_ms: Some(20.0),
            band_percent: Some(5.0),
            signal: Some("amplitude_um".to_owned()),
            text: None,
        };
    };
    let now = runs.write("now", "2026-03-05T00:00:00Z", defined);
    let then = |record: &mut RunRecord| {
        defined(record);
        set_passed(record);
        change(&mut record.scenarios[0].expectations[0]);
    };
    runs.write("then", "2026-03-04T00:00:00Z", then);
    let text = not_passed_since(&now);
    assert!(
        text.starts_with(&format!("New in this run. It last passed in then (2026-03-04T00:00:00Z{expected})")),
        "{text}"
    );
    runs.write("then", "2026-03-04T00:00:00Z", |record| {
        defined(record);
        let same = record.scenarios[0].expectations[0].clone();
        then(record);
        record.scenarios[0].expectations.push(same);
    });
    let text = not_passed_since(&now);
    assert_eq!(text.starts_with("Since then (2026-03-04T00:00:00Z) or before"), !expected.is_empty(), "{text}");
}

#[test]
fn the_trend_shows_value_and_margin_of_earlier_runs() {
    let runs = RunFolders::new();
    let measured = |value: f64| {
        move |record: &mut RunRecord| {
            let expectation = &mut record.scenarios[0].expectations[0];
            expectation.value = Some(value);
            expectation.margin = Some(expectation.limit.margin(value, 10.0));
            expectation.verdict = if value <= 2.0 { Verdict::Pass } else { Verdict::Fail };
        }
    };
    let trend = |(record, folder): &(RunRecord, PathBuf)| {
        let path = folder.join(page::FILE);
        page::ReportPage::new(record, folder).with_earlier_runs().write(&path).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        text.split_once("<svg class=\"trend\"").map(|(_, rest)| rest.split_once("</svg>").unwrap().0.to_owned())
    };
    let now = runs.write("now", "2026-03-05T00:00:00Z", measured(1.9));
    assert_eq!(trend(&now), None, "a single run has no trend");
    runs.write("a", "2026-03-01T00:00:00Z", measured(2.4));
    runs.write("b", "2026-03-02T00:00:00Z", measured(1.6));
    runs.write("other-limit", "2026-03-03T00:00:00Z", |record| {
        measured(1.0)(record);
        record.scenarios[0].expectations[0].limit = Limit::AtMost(9.0);
    });
    let drawing = trend(&now).unwrap();
    let label = "a: 2.4 ms, margin -20 %; b: 1.6 ms, margin 20 %; this run: 1.9 ms, margin 5 %";
    assert!(drawing.contains(label), "{drawing}");
    let heights: Vec<f64> =
        drawing.split("cy=\"").skip(1).map(|part| part.split('"').next().unwrap().parse().unwrap()).collect();
    let limit = drawing.split_once("class=\"s-mark\" d=\"m20 ").unwrap().1.split_once('l').unwrap().0;
    let limit: f64 = limit.parse().unwrap();
    assert!(heights[0] < limit && limit < heights[2] && heights[2] < heights[1], "{drawing}");
    assert_eq!((drawing.matches("class=\"f-fail\"").count(), drawing.matches("class=\"f-pass\"").count()), (1, 2));
}
