//! The console's text.

use crate::made;
use platebench_report::{Progress, Style, console};
use platebench_verdict::record::Overrides;
use std::io::{self, Write};
use std::sync::{Arc, Mutex};

#[test]
fn every_outcome_in_one_table() {
    let text = console::table(&made::mixed(), Style::default());
    insta::assert_snapshot!(text);
    assert!(text.lines().all(|line| line.chars().count() <= 100), "{text}");
}

#[test]
fn colour_changes_nothing_but_colour() {
    let record = made::mixed();
    let coloured = console::table(&record, Style { colour: true });
    assert!(
        coloured.contains("\u{1b}[1;31m✗ fail\u{1b}[0m") && coloured.contains("\u{1b}[33m? inconclusive: rig\u{1b}[0m")
    );
    let mut plain = coloured;
    for code in ["0", "1", "2", "32", "33", "1;31"] {
        plain = plain.replace(&format!("\u{1b}[{code}m"), "");
    }
    assert_eq!(plain, console::table(&record, Style::default()));
}

#[test]
fn a_run_without_anything_does_not_look_green() {
    let mut record = made::run(Vec::new());
    record.complete = false;
    let text = console::table(&record, Style::default());
    assert_eq!(
        text,
        "0 scenarios: 0 passed, 0 failed, 0 inconclusive\n0 expectations: 0 passed, 0 failed, 0 inconclusive\n\
         not as the scenarios have it: seed 7\nthe run was not finished\nverdict: ? inconclusive\n"
    );
}

/// A variable of the environment may have changed what was played: nobody has to look for that.
#[test]
fn what_was_changed_in_the_scenarios_is_said_beside_the_verdict() {
    let mut record = made::run(Vec::new());
    let said = |record: &platebench_verdict::RunRecord| {
        let text = console::table(record, Style::default());
        text.lines().find(|line| line.starts_with("not as")).map(str::to_owned)
    };
    record.overrides.law = Some("dq-pi".to_owned());
    record.overrides.trials = Some(1);
    assert_eq!(said(&record).as_deref(), Some("not as the scenarios have it: law dq-pi, trials 1, seed 7"));
    record.overrides = Overrides::default();
    record.overrides = platebench_verdict::record::Overrides::default();
    assert_eq!(said(&record), None);
}

#[test]
fn a_step_that_became_longer_is_told_below_the_counts() {
    let mut record = made::run(Vec::new());
    record.cost = made::costs();
    let text = console::table(&record, Style::default());
    let told: Vec<&str> = text.lines().skip(2).take_while(|line| !line.starts_with("verdict")).collect();
    assert_eq!(
        told,
        [
            "instructions per step: 3 332 worst (dq-pi), 2.0 % of the 168 000 of a 1 ms period",
            "  ↳ 30 % more than 2 563 of build 1a2b3c4d (run 20260301T093000Z-abcdef)",
            "instructions per step: 2 640 worst (dq-pi-euler), 1.6 % of the 168 000 of a 1 ms period",
            "  ↳ mean 2 410 over the 42 trials that both played: 3.6 % less than 2 500 of build 00112233 (the",
            "    image that comes with the bench)",
            "instructions per step: 2 494 worst (open-loop), 1.5 % of the 168 000 of a 1 ms period",
            "not as the scenarios have it: seed 7",
        ]
    );
}

#[derive(Clone, Default)]
struct Shared(Arc<Mutex<Vec<u8>>>);

impl Write for Shared {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn progress_in_lines_says_when_a_scenario_starts_and_ends() {
    let shared = Shared::default();
    let record = made::mixed();
    let mut progress = Progress::lines_to(shared.clone());
    progress.scenario_started("paper/fig13-open-loop.toml", 3);
    progress.trial_finished("paper/fig13-open-loop.toml", 0);
    progress.scenario_finished(&record.scenarios[1]);
    progress.finish();
    let text = String::from_utf8(shared.0.lock().unwrap().clone()).unwrap();
    assert_eq!(text, "… paper/fig13-open-loop.toml: 3 trials\n✗ paper/fig13-open-loop.toml: fail, 3 trials\n");
}
