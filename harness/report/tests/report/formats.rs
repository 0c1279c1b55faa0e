//! Tests Markdown, annotations and JSON lines.

use crate::fixtures;
use platebench_document::Style;
use platebench_model::record::{
    Event, MergeRecord, MissingShard, MissingValue, PlannedScenario, Reason, RunRecord, ScenarioRecord, TrialFinding,
    Verdict,
};
use platebench_report::events::{EventWriter, run_finished};
use platebench_report::github::{self, SourceLocation};
use platebench_report::{Detail, console, junit, page};
use rstest::rstest;
use serde_json::Value;
use std::io::{self, Write};
use std::sync::{Arc, Mutex};

fn cancelled_run() -> RunRecord {
    let mut record = fixtures::mixed_run();
    record.complete = false;
    record.verdict = Verdict::Inconclusive;
    record.scenarios.truncate(1);
    record.scenarios[0].expectations.clear();
    record.scenarios[0].verdict = Verdict::Inconclusive;
    record
}

/// Renders the record as JUnit, console, Markdown, annotations, JSON lines and page.
fn every_format(record: &RunRecord) -> [String; 6] {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    junit::write(record, &path).unwrap();
    page::write(record, folder.path()).unwrap();
    let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
    let log = FlushLog::default();
    EventWriter::new(log.clone()).write(&run_finished(Some(record), None, 1));
    let events = String::from_utf8(log.0.lock().unwrap().0.clone()).unwrap();
    [
        read(junit::FILE),
        console::run_text(record, Style::default(), Detail::Summary),
        github::render_page(record),
        github::workflow_commands(record, &|_, _| None),
        events,
        read(page::FILE),
    ]
}

#[rstest]
#[case::drive_after_safe(
    |record: &mut RunRecord| record.drive_after_safe = true,
    Verdict::Fail,
    "the controller commanded a drive after it had confirmed 0 V"
)]
#[case::drive_and_cut_short(
    |record: &mut RunRecord| (record.drive_after_safe, record.complete) = (true, false),
    Verdict::Fail,
    "the controller commanded a drive after it had confirmed 0 V; the run was not finished"
)]
#[case::not_confirmed(
    |record: &mut RunRecord| record.safe_confirmed = Some(false),
    Verdict::Inconclusive,
    "the controller did not confirm 0 V"
)]
#[case::missing_shard(
    |record: &mut RunRecord| {
        let missing = MissingShard { board: "hosted".to_owned(), shard: 2, shards: 3 };
        record.merge = Some(MergeRecord { missing_shards: vec![missing], ..MergeRecord::default() });
    },
    Verdict::Inconclusive,
    "shard 2/3 of hosted is missing"
)]
fn every_format_has_the_verdict_of_the_run_and_its_reason(
    #[case] change: fn(&mut RunRecord),
    #[case] verdict: Verdict,
    #[case] reason: &str,
) {
    let mut record = fixtures::run(fixtures::mixed_run().scenarios.drain(..1).collect());
    change(&mut record);
    record.update_verdict();
    assert_eq!(record.verdict, verdict);
    let (counts, level, sign) = match verdict {
        Verdict::Fail => (r#"failures="1" errors="0">"#, "::error title=platebench::", "✗"),
        _ => (r#"failures="0" errors="1">"#, "::warning title=platebench::", "?"),
    };
    for (text, expected) in every_format(&record).into_iter().zip([
        counts.to_owned(),
        format!("verdict: {sign} {verdict}\n\nnot passed:\n  {sign} the whole run: "),
        format!("## {sign} platebench: {verdict}"),
        level.to_owned(),
        format!(r#""verdict":"{verdict}""#),
        format!("badge {verdict}"),
    ]) {
        // The console wraps long lines.
        let unwrapped = text.replace("\n    ", " ");
        assert!(text.contains(&expected) && unwrapped.contains(reason), "{expected}, {reason}: {text}");
    }
}

#[test]
fn a_required_scenario_that_is_not_applicable_fails_in_every_format() {
    let mut record = fixtures::run(fixtures::mixed_run().scenarios.drain(..1).collect());
    record.not_applicable = fixtures::mixed_run().not_applicable;
    record.overrides.require_all = true;
    record.update_verdict();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    junit::write(&record, &path).unwrap();
    let junit = std::fs::read_to_string(&path).unwrap();
    page::write(&record, folder.path()).unwrap();
    let html = std::fs::read_to_string(folder.path().join(page::FILE)).unwrap();
    for (text, expected, unexpected) in [
        (junit.clone(), r#" failures="1" errors="0">"#, "<skipped"),
        (junit, r#"type="fail""#, "inconclusive"),
        (
            github::render_page(&record),
            "| ✗ | laws/foreign.toml |  |  |  | fail: not applicable: ",
            "| Not applicable |",
        ),
        (
            github::workflow_commands(&record, &|_, _| None),
            "::error title=laws/foreign.toml::not applicable",
            "warning",
        ),
        (
            console::run_text(&record, Style::default(), Detail::Summary),
            "\nnot passed:\n  ✗ laws/foreign.toml: not applicable",
            "\nnot applicable: ",
        ),
        (html, "<p class=\"why\">not applicable: ", "1 scenario not applicable"),
    ] {
        assert!(text.contains(expected) && !text.contains(unexpected), "{expected}: {text}");
        assert!(text.contains("laws/foreign.toml") && text.contains("does not announce the law"), "{text}");
    }
}

#[test]
fn writes_a_summary() {
    insta::assert_snapshot!("summary", github::render_page(&fixtures::mixed_run()));
    insta::assert_snapshot!("summary-cut-short", github::render_page(&cancelled_run()));
}

#[test]
fn a_summary_names_the_fault_of_the_end() {
    let mut record = cancelled_run();
    record.safe_confirmed = Some(false);
    assert!(github::render_page(&record).contains("the controller did not confirm 0 V; the run was not finished"));
    record.rig.name = "serial:/dev/ttyUSB0@1000000".to_owned();
    assert!(github::render_page(&record).contains("# Check the amplifier before you touch the plate.\n"));
    record.drive_after_safe = true;
    let page = github::render_page(&record);
    assert!(
        !page.contains("did not confirm") && page.contains("commanded a drive after it had confirmed 0 V"),
        "{page}"
    );
}

#[test]
fn a_summary_is_smaller_than_one_mebibyte() {
    let mut record = fixtures::mixed_run();
    let many = std::iter::repeat_with(|| record.scenarios[1].clone()).take(2_000).collect();
    record.scenarios = many;
    for expectation in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.expectations) {
        expectation.reason = Some(Reason::Trial {
            trial: 0,
            divergence: None,
            finding: TrialFinding::Missing(MissingValue::NotRunning),
            ended: Some("µ|".repeat(10_000)),
            stopped: None,
        });
    }
    let page = github::render_page(&record);
    assert!(page.len() < 1 << 20, "{}", page.len());
    assert!(page.contains("… and 1800 more."));
}

#[test]
fn a_summary_is_appended() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("summary.md");
    let page = github::render_page(&fixtures::mixed_run());
    github::append_markdown(&page, &path).unwrap();
    github::append_markdown(&page, &path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{page}\n{page}\n"));
}

#[test]
fn annotations_point_at_expectations() {
    let place = |scenario: &ScenarioRecord, index: Option<usize>| {
        Some(SourceLocation { file: format!("scenarios/{}", scenario.file), line: index.map_or(1, |index| 10 + index) })
    };
    insta::assert_snapshot!("annotations", github::workflow_commands(&fixtures::mixed_run(), &place));
    insta::assert_snapshot!("annotations-cut-short", github::workflow_commands(&cancelled_run(), &|_, _| None));
    let mut passed = fixtures::mixed_run();
    passed.scenarios.truncate(1);
    passed.verdict = Verdict::Pass;
    assert_eq!(github::workflow_commands(&passed, &place), "");
}

/// The written bytes, and their number at each flush.
#[derive(Clone, Default)]
struct FlushLog(Arc<Mutex<(Vec<u8>, Vec<usize>)>>);

impl Write for FlushLog {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().0.extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let mut log = self.0.lock().unwrap();
        let length = log.0.len();
        log.1.push(length);
        Ok(())
    }
}

#[test]
fn every_event_is_one_flushed_line() {
    let record = fixtures::mixed_run();
    let log = FlushLog::default();
    let mut events = EventWriter::new(log.clone());
    let scenario = &record.scenarios[0];
    let (file, trial) = (scenario.file.clone(), Box::new(scenario.trials[0].clone()));
    let [folder, rig, clock] = ["runs/x", "hosted", "lockstep"].map(str::to_owned);
    let scenarios = vec![PlannedScenario { scenario: file.clone(), trials: 1 }];
    events.write(&Event::RunStarted { format: Event::FORMAT, folder, rig, clock, scenarios });
    events.write(&Event::ScenarioStarted { scenario: file.clone(), trials: 1 });
    events.write(&Event::TrialFinished { scenario: file, trial, rows: Vec::new() });
    events.write(&Event::scenario_finished(scenario));
    events.write(&run_finished(Some(&record), None, 1));
    events.write(&run_finished(None, Some("nothing to run"), 4));
    let (bytes, flushes) = log.0.lock().unwrap().clone();
    let text = String::from_utf8(bytes).unwrap();
    let ends: Vec<usize> = text.match_indices('\n').map(|(at, _)| at + 1).collect();
    assert_eq!(ends, flushes);
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 6);
    assert_eq!(lines[2]["trial"], serde_json::to_value(&scenario.trials[0]).unwrap());
    assert_eq!(lines[3]["expectations"], serde_json::to_value(&scenario.expectations).unwrap());
    insta::assert_snapshot!("events-last-lines", text.lines().skip(4).collect::<Vec<_>>().join("\n"));
    insta::assert_snapshot!("events-first-lines", text.lines().take(2).collect::<Vec<_>>().join("\n"));
}
