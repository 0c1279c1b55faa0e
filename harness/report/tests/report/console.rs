//! Tests the text of the console.

use crate::fixtures;
use crate::hostile_text::written;
use platebench_record::Overrides;
use platebench_report::{Progress, Style, console};

#[test]
fn shows_every_outcome() {
    let text = console::run_table(&fixtures::mixed_run(), Style::default());
    insta::assert_snapshot!(text);
    assert!(text.lines().all(|line| line.chars().count() <= 100), "{text}");
}

#[test]
fn colours_change_no_text() {
    let record = fixtures::mixed_run();
    let coloured = console::run_table(&record, Style { colour: true });
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
        "0 scenarios: 0 passed, 0 failed, 0 inconclusive\n0 expectations: 0 passed, 0 failed, 0 inconclusive\n\
         overridden: seed = 7\nthe run was not finished\nverdict: ? inconclusive\n"
    );
}

#[test]
fn lists_overrides() {
    let mut record = fixtures::run(Vec::new());
    let overrides = |record: &platebench_record::RunRecord| {
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
    let lines: Vec<&str> = text.lines().skip(2).take_while(|line| !line.starts_with("verdict")).collect();
    assert_eq!(
        lines,
        [
            "instructions per step: 3 332 worst (dq-pi), 2.0 % of 1 ms at 168 MHz",
            "  ↳ 30 % more than 2 563 of build 1a2b3c4d (run 20260301T093000Z-abcdef)",
            "instructions per step: 2 640 worst (dq-pi-euler), 1.6 % of 1 ms at 168 MHz",
            "  ↳ mean 2 410 over the 42 trials of both runs: 3.6 % less than 2 500 of build 00112233 (the image",
            "    that comes with the bench)",
            "instructions per step: 2 494 worst (open-loop), 1.5 % of 1 ms at 168 MHz",
            "overridden: seed = 7",
        ]
    );
}

#[test]
fn progress_has_a_line_at_start_and_end() {
    let record = fixtures::mixed_run();
    let text = written(|out| {
        let mut progress = Progress::to_writer(out);
        progress.scenario_started("paper/fig13-open-loop.toml", 3);
        progress.trial_finished("paper/fig13-open-loop.toml", 0);
        progress.scenario_finished(&record.scenarios[1]);
        progress.finish();
    });
    assert_eq!(text, "… paper/fig13-open-loop.toml: 3 trials\n✗ paper/fig13-open-loop.toml: fail, 3 trials\n");
}
