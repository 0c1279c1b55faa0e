//! Tests TAP, Markdown, annotations and JSON lines.

use crate::fixtures;
use platebench_model::record::{Event, MissingValue, Reason, RunRecord, ScenarioRecord, TrialFinding, Verdict};
use platebench_report::events::EventWriter;
use platebench_report::github::{self, SourceLocation};
use platebench_report::tap::{self, TapVersion};
use platebench_report::{Detail, Style, console, junit, page};
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

#[test]
fn writes_tap() {
    insta::assert_snapshot!("tap", tap::text(&fixtures::mixed_run(), TapVersion::V14));
    insta::assert_snapshot!("tap-cut-short", tap::text(&cancelled_run(), TapVersion::V13));
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
        (tap::text(&record, TapVersion::V14), "not ok 2 - laws/foreign.toml\n  ---\n  verdict: \"fail\"\n", "SKIP"),
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
fn every_tap_plan_has_its_number_of_points() {
    for record in [fixtures::mixed_run(), cancelled_run(), fixtures::run(Vec::new())] {
        let text = tap::text(&record, TapVersion::V13);
        let mut plans = 0;
        for indent in ["", "    "] {
            let mut expected = 0;
            let lines = text.lines().filter_map(|line| line.strip_prefix(indent)).filter(|line| !line.starts_with(' '));
            for line in lines {
                if let Some(points) = line.strip_prefix("1..") {
                    assert_eq!(expected, 0, "{text}");
                    expected = points.parse::<usize>().unwrap();
                    plans += 1;
                } else if line.starts_with("ok ") || line.starts_with("not ok ") {
                    expected -= 1;
                }
            }
            assert_eq!(expected, 0, "{text}");
        }
        assert_eq!(plans, 1 + record.scenarios.len());
        assert_eq!(text.matches("# SKIP").count(), record.not_applicable.len());
        assert!(!text.contains("# TODO"));
        let passed = record.scenarios.iter().flat_map(|scenario| &scenario.expectations);
        let passed = passed.filter(|expectation| expectation.verdict == Verdict::Pass).count();
        assert_eq!(text.lines().filter(|line| line.starts_with("    ok ")).count(), passed);
    }
    assert!(tap::text(&cancelled_run(), TapVersion::V13).ends_with("Bail out! the run was not finished\n"));
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
    assert!(github::render_page(&record).contains("the controller did not confirm 0 V.**"));
    record.rig.name = "serial:/dev/ttyUSB0@1000000".to_owned();
    let missing = "the controller did not confirm 0 V: check the amplifier";
    assert!(github::render_page(&record).contains(missing));
    record.drive_after_safe = true;
    let page = github::render_page(&record);
    assert!(!page.contains(missing) && page.contains("commanded a drive after it had confirmed 0 V"), "{page}");
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
        });
    }
    let page = github::render_page(&record);
    assert!(page.len() < 1 << 20, "{}", page.len());
    assert!(page.contains("… and 1800 more."));
}

#[test]
fn a_summary_is_appended_or_replaces() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("summary.md");
    let page = github::render_page(&fixtures::mixed_run());
    github::append_markdown(&fixtures::mixed_run(), &path).unwrap();
    github::append_markdown(&fixtures::mixed_run(), &path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{page}\n{page}\n"));
    github::write_markdown(&fixtures::mixed_run(), &path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), page);
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
    events.run_started("runs/x", "hosted", "lockstep", &[(scenario.file.clone(), 1)]);
    let (file, trial) = (scenario.file.clone(), Box::new(scenario.trials[0].clone()));
    events.event(&Event::ScenarioStarted { file: file.clone(), trials: 1 });
    events.event(&Event::TrialFinished { file, trial, rows: Vec::new() });
    events.event(&Event::ScenarioFinished(Box::new(scenario.into())));
    events.run_finished(Some(&record), None, 1);
    events.run_finished(None, Some("nothing to run"), 4);
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
