//! Tests what a run with `--fail-fast` plays.

use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, step_text};
use Verdict::{Fail, Inconclusive, Pass};
use platebench_model::record::{Cause, RunRecord, ScenarioRecord, Verdict};

fn verdicts(record: &RunRecord) -> Vec<(Verdict, usize)> {
    record.scenarios.iter().map(|scenario| (scenario.verdict, scenario.trials.len())).collect()
}

#[test]
fn fail_fast_plays_nothing_after_a_failure() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &step_text(SETTLING));
    folder.write_scenario("b.toml", &step_text(FAILED_SETTLING));
    folder.write_scenario("c.toml", &step_text(SETTLING));
    let run = |out: &str, more: &[&str]| {
        folder.bench(["run", "--rig", "hosted", "--jobs", "1", "--out", out].iter().chain(more)).assert_exit(1);
        folder.record(out)
    };
    assert_eq!(verdicts(&run("all", &[])), [(Pass, 1), (Fail, 1), (Pass, 1)]);
    let record = run("run", &["--fail-fast"]);
    assert_eq!(verdicts(&record), [(Pass, 1), (Fail, 1), (Inconclusive, 0)]);
    assert!(record.complete && record.verdict == Fail);
    assert!(!folder.join("run/traces/c/000.csv").exists());
    let expectation = &record.scenarios[2].expectations[0];
    assert_eq!(expectation.cause, Some(Cause::Evidence));
    assert_eq!(expectation.reason.as_ref().unwrap().to_string(), "0 of 1 trials were played");
    assert_judged_again(&folder, &record.scenarios);
}

#[test]
fn fail_fast_keeps_the_trials_of_an_undecided_scenario() {
    let folder = TestFolder::new();
    let repeatability = step_text("metric = \"repeatability_percent\"\nat_most = 1.5").replace("60.0", "80.0");
    let spread = "[trials]\ncount = 3\nmax_count = 40\n[trials.spread]\nsensor_gain_percent = 1.0\n";
    folder.write_scenario("undecided.toml", &format!("{repeatability}{spread}"));
    folder.write_scenario("fails.toml", &step_text(FAILED_SETTLING));
    folder.bench(["run", "--rig", "hosted", "--jobs", "1", "--out", "run", "--fail-fast"]).assert_exit(1);
    let record = folder.record("run");
    assert_eq!(verdicts(&record), [(Verdict::Fail, 1), (Verdict::Inconclusive, 3)]);
    assert_judged_again(&folder, &record.scenarios);
}

#[track_caller]
fn assert_judged_again(folder: &TestFolder, expected: &[ScenarioRecord]) {
    let judged = folder.bench(["report", "run", "--rejudge", "--format", "json"]).assert_exit(1).json();
    for (scenario, expected) in judged["scenarios"].as_array().unwrap().iter().zip(expected) {
        assert_eq!(scenario["expectations"], serde_json::to_value(&expected.expectations).unwrap());
    }
}
