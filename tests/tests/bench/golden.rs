//! Compares runs with the baselines of the paper's scenarios, and with tubes learned from trials.

use crate::test_folder::{ProgramOutput, SETTLING, TestFolder, run_bench, step_scenario, step_text, workspace_root};
use platebench_model::record::RunRecord;
use platebench_verdict::golden::judged_values;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

const HEAD: &str = "scenarios/baselines/s.toml";

fn run_paper(folder: &Path, more: &[&str]) {
    let paper = workspace_root().join("scenarios/paper");
    run_bench(folder, ["run", paper.to_str().unwrap(), "--rig", "hosted", "--out", "run"].iter().chain(more));
}

fn compare_with_baselines(folder: &Path) -> ProgramOutput {
    let baselines = workspace_root().join("scenarios/baselines").display().to_string();
    run_bench(folder, ["compare", "run", "baseline", "--baselines", &baselines])
}

#[track_caller]
fn compare(folder: &TestFolder, subject: &str, reference: &str) -> ProgramOutput {
    folder.bench(["compare", subject, reference])
}

#[test]
fn the_paper_s_scenarios_match_their_baselines() {
    let folder = tempfile::tempdir().unwrap();
    run_paper(folder.path(), &[]);
    let output = compare_with_baselines(folder.path()).assert_exit(0);
    assert_eq!(output.text().matches("✓ pass  paper/").count(), 11);
    assert!(!folder.path().join("run/comparison").exists(), "no difference to draw");
    insta::assert_snapshot!("judged_values_of_the_paper_s_scenarios", value_table(&folder.path().join("run")));
}

#[test]
fn another_law_differs_from_every_baseline() {
    let folder = tempfile::tempdir().unwrap();
    run_paper(folder.path(), &["--law", "dq-pi-euler"]);
    let output = compare_with_baselines(folder.path())
        .assert_text(1, &["trial 0: amplitude_um is 2.33 µm at 2 ms, 0.6989 µm outside ± 0.01795 µm around 1.59 µm"]);
    assert_eq!(output.text().matches("✗ fail  paper/").count(), 11, "{}", output.text());
    let svg = fs::read_to_string(folder.path().join("run/comparison/paper/fig13-closed-loop.svg")).unwrap();
    assert!(svg.contains("amplitude_um at 2 ms"));
}

/// The values that a baseline keeps.
fn value_table(run: &Path) -> String {
    let mut table = String::new();
    for scenario in RunRecord::read(run).unwrap().scenarios {
        let values = judged_values(&scenario).into_iter().map(|(name, value)| format!("{name} {value}"));
        writeln!(table, "{}: {}", scenario.file, values.collect::<Vec<_>>().join(", ")).unwrap();
    }
    table
}

fn run_folder(text: &str) -> TestFolder {
    let folder = TestFolder::with_scenario(text);
    folder.run_hosted("run");
    folder
}

const SPREAD: &str = "[trials]\ncount = 30\n[trials.spread]\nsensor_gain_percent = 0.2\ntime_constant_percent = 1.0\n";

#[test]
fn a_tube_is_learned_from_varying_trials() {
    let expect = "metric = \"settling_time_ms\"\nat_most = 6.0\nover = \"mean\"";
    let folder = run_folder(&(step_scenario("aluminium-198x138-noisy", "", "", expect) + SPREAD));
    folder
        .bench(["baseline", "accept", "run", "--false-alarm-rate", "0.01"])
        .assert_text(2, &["a false-alarm rate of 0.01 needs at least 148 trials, this run has 30"]);
    folder.bench(["baseline", "accept", "run"]).assert_exit(0);
    let head = folder.read(HEAD);
    assert!(head.contains("[learned]\ntrials = 30\nfalse_alarm_rate = 0.05"), "{head}");
    folder.bench(["run", "--rig", "hosted", "--out", "other", "--seed", "1000"]);
    let output = compare(&folder, "other", "baseline");
    assert_ne!(output.exit, 1, "{}", output.text());
    // Only runs with equal seeds have equal noise.
    compare(&folder, "run", "run").assert_exit(0);
    compare(&folder, "other", "run").assert_exit(1);
    folder.bench(["run", "--rig", "hosted", "--out", "few", "--trials", "3"]);
    compare(&folder, "few", "run").assert_exit(0);
    compare(&folder, "run", "few").assert_text(3, &["the reference has no complete trial 3"]);
}

#[test]
fn a_run_without_scenarios_does_not_pass() {
    let folder = run_folder(&step_text(SETTLING));
    let mut record = folder.record("run");
    record.scenarios.clear();
    record.journal = None;
    fs::create_dir(folder.join("nothing")).unwrap();
    record.write(&folder.join("nothing")).unwrap();
    for arguments in [
        &["report", "nothing", "--rejudge"][..],
        &["report", "--merge", "nothing", "--out", "joined"],
        &["compare", "nothing", "run"],
        &["compare", "run", "nothing"],
        &["baseline", "accept", "nothing"],
    ] {
        folder.bench(arguments).assert_exit(4);
    }
}
