//! Since when something does not pass, as `report.html` says it.

use crate::html::{open, written};
use crate::made;
use platebench_report::html;
use platebench_verdict::{Definition, ExpectationRecord, RunRecord, Verdict};
use rstest::rstest;
use serde_json::{Map, json};
use std::fs;
use std::path::PathBuf;

/// Runs of the open loop in folders beside each other.
struct Runs(tempfile::TempDir);

impl Runs {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// Leaves a run there in which the open loop settles too late; `change` makes it another one.
    fn write(&self, name: &str, started: &str, change: impl FnOnce(&mut RunRecord)) -> (RunRecord, PathBuf) {
        let mut record = made::run(vec![open()]);
        started.clone_into(&mut record.started);
        change(&mut record);
        let folder = self.0.path().join(name);
        fs::create_dir_all(&folder).unwrap();
        record.write(&folder).unwrap();
        (record, folder)
    }
}

fn passes(record: &mut RunRecord) {
    record.scenarios[0].expectations[0].verdict = Verdict::Pass;
}

/// Since when, as the page of a run says it.
fn since((record, folder): &(RunRecord, PathBuf)) -> String {
    let path = folder.join(html::FILE);
    html::Page::new(record, folder).with_earlier_runs().write(&path).unwrap();
    let page = fs::read_to_string(&path).unwrap();
    page.split_once("<p class=\"since\">").unwrap().1.split_once("</p>").unwrap().0.to_owned()
}

#[test]
fn since_when_something_fails_is_said() {
    let runs = Runs::new();
    let now = runs.write("now", "2026-03-05T00:00:00Z", |_| ());
    assert!(!written(&now.0, &now.1).contains("class=\"since\""), "nobody looked");
    assert_eq!(since(&now), "No earlier run of it lies beside this one.");
    runs.write("later", "2026-03-06T00:00:00Z", passes);
    assert_eq!(since(&now), "No earlier run of it lies beside this one.");
    runs.write("d", "2026-03-04T00:00:00Z", |_| ());
    assert_eq!(
        since(&now),
        "Since d (2026-03-04T00:00:00Z) or before: it has not passed in any earlier run on <code>hosted</code> with <code>open-loop</code> that lies beside this one."
    );
    runs.write("c", "2026-03-03T00:00:00Z", |_| ());
    runs.write("b", "2026-03-02T00:00:00Z", passes);
    runs.write("a", "2026-03-01T00:00:00Z", |_| ());
    let text = since(&now);
    assert!(text.starts_with("Since c (2026-03-03T00:00:00Z), 2 runs ago. It last passed in b (2026-03-02"), "{text}");
    runs.write("d", "2026-03-04T00:00:00Z", passes);
    let text = since(&now);
    assert!(
        text.starts_with("New in this run. It last passed in d (2026-03-04T00:00:00Z), with the same build"),
        "{text}"
    );
    fs::write(runs.0.path().join("d/run.json"), "damaged").unwrap();
    assert!(since(&now).starts_with("Since c (2026-03-03T00:00:00Z), one run ago. It last passed in b"));
}

/// What another law did, or a controller on another kind of rig, says nothing of this one.
#[test]
fn only_runs_on_the_same_kind_of_rig_and_with_the_same_law_count() {
    const NONE: &str =
        "No earlier run of it on <code>emulated</code> with <code>open-loop</code> lies beside this one.";
    let runs = Runs::new();
    let rig = |record: &mut RunRecord, name: &str| name.clone_into(&mut record.rig.name);
    let now = runs.write("now", "2026-03-05T00:00:00Z", |record| rig(record, "emulated:mine.elf"));
    runs.write("another-rig", "2026-03-04T00:00:00Z", |record| {
        passes(record);
        rig(record, "serial:/dev/x");
    });
    assert_eq!(since(&now), NONE);
    runs.write("another-law", "2026-03-03T00:00:00Z", |record| {
        passes(record);
        rig(record, "emulated");
        "dq-pi".clone_into(&mut record.scenarios[0].law);
    });
    assert_eq!(since(&now), NONE);
    runs.write("failed", "2026-03-02T00:00:00Z", |record| rig(record, "emulated"));
    assert!(since(&now).starts_with("Since failed (2026-03-02T00:00:00Z) or before: it has not passed in any earlier run on <code>emulated</code> with"));
    runs.write("passed", "2026-03-01T00:00:00Z", |record| {
        passes(record);
        rig(record, "emulated");
    });
    assert!(since(&now).contains("one run ago. It last passed in passed (2026-03-01T00:00:00Z), with the same build"));
}

#[rstest]
#[case::same(|_: &mut ExpectationRecord| (), "")]
#[case::limit(|then: &mut ExpectationRecord| then.limit = Map::from_iter([("at_most".to_owned(), json!(60.0))]), ", then with ≤ 60 ms")]
#[case::statistic(|then: &mut ExpectationRecord| "mean".clone_into(&mut then.statistic), ", then with the mean of trials")]
#[case::band(|then: &mut ExpectationRecord| then.definition.band_percent = Some(2.0), ", then with a band of 2 %")]
#[case::from(|then: &mut ExpectationRecord| then.definition.from_ms = Some(40.0), ", then with a look from 40 ms on")]
#[case::signal(|then: &mut ExpectationRecord| then.definition.signal = Some("wd_um".to_owned()), ", then with a look at wd_um")]
#[case::from_nowhere(|then: &mut ExpectationRecord| then.definition.from_ms = None, ", then with no instant to look from")]
#[case::silent(|then: &mut ExpectationRecord| then.definition = Definition::default(), "")]
fn where_it_was_another_expectation_then_it_is_said_which(
    #[case] change: fn(&mut ExpectationRecord),
    #[case] expected: &str,
) {
    let runs = Runs::new();
    let defined = |record: &mut RunRecord| {
        record.scenarios[0].expectations[0].definition =
            Definition { from_ms: Some(20.0), band_percent: Some(5.0), signal: Some("amplitude_um".to_owned()) };
    };
    let now = runs.write("now", "2026-03-05T00:00:00Z", defined);
    let then = |record: &mut RunRecord| {
        defined(record);
        passes(record);
        change(&mut record.scenarios[0].expectations[0]);
    };
    runs.write("then", "2026-03-04T00:00:00Z", then);
    let text = since(&now);
    assert!(
        text.starts_with(&format!("New in this run. It last passed in then (2026-03-04T00:00:00Z{expected})")),
        "{text}"
    );
    // Where the very same stood there too, under another number, that one counts.
    runs.write("then", "2026-03-04T00:00:00Z", |record| {
        defined(record);
        let same = record.scenarios[0].expectations[0].clone();
        then(record);
        record.scenarios[0].expectations.push(same);
    });
    let text = since(&now);
    assert_eq!(text.starts_with("Since then (2026-03-04T00:00:00Z) or before"), !expected.is_empty(), "{text}");
}
