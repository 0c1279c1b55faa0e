//! Tests the text of the console.

use crate::fixtures;
use crate::hostile_text::written;
use platebench_document::Style;
use platebench_model::record::{ClockKind, Event, NotApplicable, Overrides, Quantiles, RunRecord, TimingRecord};
use platebench_report::{Detail, Progress, console, junit, page};
use rstest::rstest;
use serde_json::json;

#[test]
fn hints_at_the_time_scale_only_if_a_run_in_real_time_is_late() {
    let mut record = fixtures::mixed_run();
    for (clock, expected) in [(ClockKind::RealTime, true), (ClockKind::Lockstep, false)] {
        record.clock = clock;
        let text = console::run_text(&record, Style::default(), Detail::Summary);
        assert_eq!(text.contains("slower --time-scale"), expected, "{text}");
    }
}

#[rstest]
#[case::usual("rfc2217:lab:4001@115200", 3.2, 3.4, true)]
#[case::raw("tcp:lab:4001", 3.2, 3.4, true)]
#[case::shortest("tcp:lab:4001", 2.8, 2.9, true)]
#[case::too_short("tcp:lab:4001", 2.7, 2.8, false)]
#[case::longest("tcp:lab:4001", 4.1, 5.1, true)]
#[case::too_long("tcp:lab:4001", 4.2, 4.3, false)]
#[case::not_constant("tcp:lab:4001", 3.2, 4.3, false)]
#[case::serial_port("serial:/dev/ttyUSB0@115200", 3.2, 3.4, false)]
fn names_the_delay_of_a_server(#[case] rig: &str, #[case] p50: f64, #[case] p99: f64, #[case] expected: bool) {
    let mut record = fixtures::mixed_run();
    record.clock = ClockKind::RealTime;
    rig.clone_into(&mut record.rig.name);
    for trial in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.trials) {
        let delay = Quantiles { p50: p50 * 1e2, p99: p99 * 1e2, ..Quantiles::default() };
        let timing = TimingRecord { time_scale: 0.1, loop_delay_us: Some(delay), ..TimingRecord::default() };
        trial.telemetry.timing = Some(Box::new(timing));
    }
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    assert_eq!(text.contains("chardelay: false"), expected, "{text}");
}

#[test]
fn names_the_scenarios_that_reached_their_time_limit() {
    let mut record = passed_run(5);
    for scenario in record.scenarios.iter_mut().skip(1) {
        scenario.time_limit_s = Some(2.0);
    }
    let names: Vec<_> = record.scenarios.iter().map(|scenario| scenario.file.clone()).collect();
    let listed = names[1..4].join(", ");
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    let expected = format!("time limit reached: 4 scenarios: {listed}, and 1 more: -v lists them\n");
    assert!(text.contains(&expected), "{expected}{text}");
}

#[test]
fn no_line_is_longer_than_the_terminal_if_its_words_are_short() {
    let record = fixtures::mixed_run();
    for detail in [Detail::Failures, Detail::Summary, Detail::Tables] {
        let style = Style { width: Some(60), ..Style::default() };
        let text = console::run_text(&record, style, detail);
        let is_long = |line: &&str| line.chars().count() > 60 && line.trim().contains(' ');
        assert_eq!(text.lines().filter(is_long).collect::<Vec<_>>(), Vec::<&str>::new());
        let wide = console::run_text(&record, Style { width: Some(400), ..Style::default() }, detail);
        assert!(wide.lines().any(|line| line.chars().count() > 100), "{wide}");
    }
}

#[test]
fn shows_every_outcome() {
    let text = console::run_table(&fixtures::mixed_run(), Style::default());
    insta::assert_snapshot!(text);
    // The first line names the controller and is not wrapped.
    assert!(text.lines().skip(1).all(|line| line.chars().count() <= 100), "{text}");
}

#[test]
fn a_summary_lists_what_did_not_pass() {
    let text = console::run_text(&fixtures::mixed_run(), Style::default(), Detail::Summary);
    insta::assert_snapshot!(text);
    // The first line names the controller and is not wrapped.
    assert!(text.lines().skip(1).all(|line| line.chars().count() <= 100), "{text}");
}

fn passed_run(scenarios: u32) -> RunRecord {
    let scenario = |index: u32| {
        let file = format!("paper/{index}.toml");
        let limits = [("at_most", json!(2.0)), ("at_most", json!(1.9)), ("within", json!([1.8, 1.8]))];
        let expectations = limits.map(|limit| fixtures::passed_expectation("settling_time_ms", limit, 1.8));
        let mut scenario = fixtures::scenario(&file, "A step", "dq-pi", expectations.to_vec());
        scenario.trials = vec![fixtures::trial(&file, 0, &[])];
        scenario.trials[0].wall_ms = Some(1_000.0 + f64::from(index));
        scenario
    };
    let mut record = fixtures::run((0..scenarios).map(scenario).collect());
    let not_applicable = |index| NotApplicable {
        file: format!("faults/{index}.toml"),
        title: String::new(),
        reason: "the controller does not announce ticks".to_owned(),
        expectations: 0,
    };
    record.not_applicable = (0..20).map(not_applicable).collect();
    record.cost = fixtures::cost_trends();
    record
}

#[test]
fn a_passed_run_is_summarised_in_few_lines() {
    let text = console::run_text(&passed_run(100), Style::default(), Detail::Summary);
    insta::assert_snapshot!(text);
    // The command line adds paths and the number of skipped scenarios.
    assert!(text.lines().count() <= 15, "{text}");
}

#[test]
fn without_failures_there_is_no_list_of_failures() {
    assert_eq!(console::run_text(&passed_run(2), Style::default(), Detail::Failures), "");
    let failures = console::run_text(&fixtures::mixed_run(), Style::default(), Detail::Failures);
    let summary = console::run_text(&fixtures::mixed_run(), Style::default(), Detail::Summary);
    let (tested, failures) = failures.split_once('\n').unwrap();
    assert!(tested.starts_with("tested: ") && failures.starts_with("verdict: ✗ fail"), "{tested}\n{failures}");
    assert!(summary.ends_with(failures), "{failures}");
}

#[rstest]
#[case::limit_zero(("at_most", json!(0.0)), false)]
#[case::one_value(("within", json!([5.0, 5.0])), false)]
#[case::limit(("at_most", json!(10.0)), true)]
#[case::range(("within", json!([5.0, 6.0])), true)]
fn limits_without_room_have_no_smallest_margin(#[case] limit: (&str, serde_json::Value), #[case] is_listed: bool) {
    let expectation = fixtures::passed_expectation("missed_replies", limit, 5.0);
    let record = fixtures::run(vec![fixtures::scenario("a.toml", "A", "dq-pi", vec![expectation])]);
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    assert_eq!(text.contains("smallest margin"), is_listed, "{text}");
}

#[test]
fn unplayed_scenarios_are_counted_instead_of_listed() {
    let mut record = fixtures::mixed_run();
    for scenario in &mut record.scenarios {
        scenario.trials.clear();
    }
    record.overrides.fail_fast = true;
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    let count = record.scenarios.len();
    assert!(text.ends_with(&format!("not played after the first failure: {count} scenarios\n")), "{text}");
}

#[rstest]
#[case::played(&[], None)]
#[case::not_played(&["a", "b", "a"], Some("not played: 2 scripts of the protocol check (a, b); `run --long-scripts` plays them\n"))]
fn scripts_that_were_not_played_are_named(#[case] scripts: &[&str], #[case] expected: Option<&str>) {
    let mut record = fixtures::mixed_run();
    let trial = record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.trials).next().unwrap();
    trial.telemetry.scripts_not_played = scripts.iter().map(|&script| script.to_owned()).collect();
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    assert_eq!(text.lines().find(|line| line.starts_with("not played: ")), expected.map(str::trim_end), "{text}");
}

#[rstest]
#[case(Detail::Summary, &["    also paper/1.toml, paper/2.toml, paper/3.toml, and 36 more: -v lists them"])]
#[case(Detail::Tables, &[
    "    also paper/0.toml: settling_time_ms, overshoot_percent",
    "    also paper/39.toml: settling_time_ms, overshoot_percent",
])]
fn expectations_with_one_cause_have_one_entry(#[case] detail: Detail, #[case] expected: &[&str]) {
    let text = console::run_text(&fixtures::trapped_run(40), Style::default(), detail);
    let (_, list) = text.split_once("not passed:\n").unwrap();
    let entry = [
        "  ✗ 40 scenarios, 80 expectations, 40 trials with one cause:",
        "    first: paper/0.toml: settling_time_ms: no value, limit ≤ 2, window 0 … 60 ms",
        "    ↳ trial 0: the controller does not run at the end: the firmware trapped: HardFault, at",
        "      0x08000100 in step, 3000 µs after power-on",
        "    trace: traces/paper/0/000.csv",
    ];
    assert!(list.starts_with(&entry.join("\n")), "{list}");
    assert_eq!(list.matches("HardFault").count(), 1, "{list}");
    for line in expected {
        assert!(list.lines().any(|found| found == *line), "{line}: {list}");
    }
}

#[test]
fn a_trap_at_another_place_is_another_cause() {
    let mut record = fixtures::trapped_run(3);
    record.scenarios[2].trials[0].telemetry.end_cause = Some("the firmware trapped: lockup".to_owned());
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    assert!(text.contains("2 scenarios, 4 expectations, 2 trials with one cause:"), "{text}");
    assert!(text.contains("1 scenario, 2 expectations, 1 trial with one cause:"), "{text}");
    assert!(text.contains("    also overshoot_percent\n"), "{text}");
}

#[test]
fn colours_change_no_text() {
    let record = fixtures::mixed_run();
    let coloured = console::run_table(&record, Style { colour: true, ..Style::default() });
    assert!(
        coloured.contains("\u{1b}[1;31m✗ fail\u{1b}[0m") && coloured.contains("\u{1b}[33m? inconclusive: rig\u{1b}[0m")
    );
    let mut plain = coloured;
    for code in ["0", "1", "2", "32", "33", "1;31"] {
        plain = plain.replace(&format!("\u{1b}[{code}m"), "");
    }
    assert_eq!(plain, console::run_table(&record, Style::default()));
}

#[test]
fn an_empty_run_does_not_pass() {
    let mut record = fixtures::run(Vec::new());
    record.complete = false;
    let text = console::run_table(&record, Style::default());
    assert_eq!(
        text,
        "tested: dq-pi 0.1.0, build 5f3a9c01; rig hosted; clock lockstep\n\n\
         0 scenarios: 0 passed, 0 failed, 0 inconclusive\n0 expectations: 0 passed, 0 failed, 0 inconclusive\n\
         duration: 2.5 s\noverridden: seed = 7\nverdict: ? inconclusive\n\nnot passed:\n  ? the whole run: the run was not finished\n"
    );
}

#[test]
fn lists_overrides() {
    let mut record = fixtures::run(Vec::new());
    let overrides = |record: &platebench_model::record::RunRecord| {
        let text = console::run_table(record, Style::default());
        text.lines().find(|line| line.starts_with("overridden")).map(str::to_owned)
    };
    record.overrides.law = Some("dq-pi".to_owned());
    record.overrides.trials = Some(1);
    assert_eq!(overrides(&record).as_deref(), Some("overridden: law = dq-pi, trials = 1, seed = 7"));
    record.overrides = Overrides::default();
    assert_eq!(overrides(&record), None);
}

#[test]
fn shows_the_cost_of_a_step_and_its_change() {
    let mut record = fixtures::run(Vec::new());
    record.cost = fixtures::cost_trends();
    let text = console::run_table(&record, Style::default());
    let lines: Vec<&str> = text.lines().skip(5).take_while(|line| !line.starts_with("verdict")).collect();
    assert_eq!(
        lines,
        [
            "instructions per step: 3 332 worst (dq-pi), 2.0 % of a period of 1 ms at 168 MHz",
            "  ↳ 30 % more than 2 563 of build 1a2b3c4d (run 20260301T093000Z-abcdef)",
            "instructions per step: 2 640 worst (dq-pi-euler), 1.6 % of a period of 1 ms at 168 MHz",
            "  ↳ mean 2 410 over the 42 trials of both runs: 3.6 % less than 2 500 of build 00112233 (the image",
            "    that comes with the bench)",
            "instructions per step: 2 494 worst (open-loop); 2 400 are 5.7 % of a period of 0.25 ms at 168 MHz",
            "overridden: seed = 7",
        ]
    );
}

#[test]
fn progress_has_a_line_at_start_and_end() {
    let record = fixtures::mixed_run();
    let text = written(|out| {
        let mut progress = Progress::to_writer(out);
        let scenario = &record.scenarios[1];
        let (file, trial) = (scenario.file.clone(), Box::new(scenario.trials[0].clone()));
        progress.show(&Event::ScenarioStarted { scenario: file.clone(), trials: 3 });
        progress.show(&Event::TrialFinished { scenario: file, trial, rows: Vec::new() });
        progress.show(&Event::scenario_finished(scenario));
        progress.finish();
    });
    assert_eq!(text, "… paper/fig13-open-loop.toml: 3 trials\n✗ paper/fig13-open-loop.toml: fail, 3 trials\n");
}

const TESTED: &str = "dq-pi 0.1.0, build 5f3a9c01; rig hosted; clock lockstep; laws dq-pi, open-loop; \
                      plate aluminium-198x138; model modal";

#[rstest]
#[case::summary(Detail::Summary)]
#[case::tables(Detail::Tables)]
#[case::failures(Detail::Failures)]
fn the_first_line_names_what_was_tested(#[case] detail: Detail) {
    let mut record = fixtures::mixed_run();
    let text = console::run_text(&record, Style::default(), detail);
    assert!(text.starts_with(&format!("tested: {TESTED}\n")), "{text}");
    assert!(!text.contains("the bench's own firmware"), "{text}");
    record.rig.bench_firmware = true;
    let text = console::run_text(&record, Style::default(), detail);
    let verdict = "verdict: ✗ fail (the bench's own firmware on the rig hosted; name yours with --rig)";
    assert!(text.lines().any(|line| line == verdict), "{text}");
    assert!(text.lines().next().unwrap().contains("build 5f3a9c01 (the bench's own firmware);"), "{text}");
}

#[test]
fn more_than_three_laws_are_counted_and_a_build_of_zeros_is_unknown() {
    let laws = ["pll", "dq-pi", "pll", "deadbeat", "bang-bang"];
    let scenario = |law: &&str| fixtures::scenario(law, law, law, Vec::new());
    let mut record = fixtures::run(laws.iter().map(scenario).collect());
    "0000000000000000".clone_into(&mut record.rig.firmware.as_mut().unwrap().build);
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    let tested = "tested: dq-pi 0.1.0, build unknown; rig hosted; clock lockstep; 4 laws; plate aluminium-198x138; \
                  model modal\n";
    assert!(text.starts_with(tested), "{text}");
}

#[rstest]
#[case::page(report_page)]
#[case::junit(junit_file)]
#[case::markdown(platebench_report::github::render_page)]
fn every_output_names_what_was_tested(#[case] render: fn(&RunRecord) -> String) {
    let mut record = fixtures::mixed_run();
    let text = render(&record);
    assert!(text.contains(TESTED), "{text}");
    record.rig.bench_firmware = true;
    let text = render(&record).replace("&apos;", "'");
    assert!(text.contains("build 5f3a9c01 (the bench's own firmware);"), "{text}");
}

fn report_page(record: &RunRecord) -> String {
    let folder = tempfile::tempdir().unwrap();
    page::write(record, folder.path()).unwrap();
    std::fs::read_to_string(folder.path().join(page::FILE)).unwrap()
}

fn junit_file(record: &RunRecord) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(junit::FILE);
    junit::write(record, &path).unwrap();
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn scenarios_that_are_not_applicable_are_counted_in_one_line() {
    let mut record = passed_run(1);
    for (scenario, reason) in record.not_applicable.iter_mut().zip(["a", "b", "b", "c", "d"]) {
        reason.clone_into(&mut scenario.reason);
    }
    let text = console::run_text(&record, Style::default(), Detail::Summary);
    let lines: Vec<&str> = text.lines().filter(|line| line.starts_with("not applicable")).collect();
    assert_eq!(lines, ["not applicable: 20 scenarios; -v lists the reasons"]);
    record.scenarios.clear();
    let reason = console::verdict_reason(&record);
    assert_eq!(reason.matches("does not announce ticks").count(), 1, "{reason}");
}
