//! Golden traces: what was accepted of the paper's scenarios, and how that is reviewed.

use crate::test_folder::{TestFolder, exit_code, run_bench, step_scenario, workspace_root};
use platebench_record::RunRecord;
use platebench_verdict::golden::ResponseFeatures;
use rstest::rstest;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn output_text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

fn baselines() -> String {
    workspace_root().join("scenarios/baselines").display().to_string()
}

fn play_paper(folder: &Path, more: &[&str]) {
    let paper = workspace_root().join("scenarios/paper");
    run_bench(folder, ["run", paper.to_str().unwrap(), "--rig", "hosted", "--out", "run"].iter().chain(more));
}

#[test]
fn the_paper_s_scenarios_match_their_baselines() {
    let folder = tempfile::tempdir().unwrap();
    play_paper(folder.path(), &[]);
    let output = run_bench(folder.path(), ["compare", "run", "--against", "baseline", "--baselines", &baselines()]);
    assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
    assert_eq!(output_text(&output).matches("✓ pass  paper/").count(), 11);
    assert!(!folder.path().join("run/comparison").exists(), "there is nothing to draw");
}

#[test]
fn another_law_differs_from_every_baseline() {
    let folder = tempfile::tempdir().unwrap();
    play_paper(folder.path(), &["--law", "dq-pi-euler"]);
    let output = run_bench(folder.path(), ["compare", "run", "--against", "baseline", "--baselines", &baselines()]);
    assert_eq!(exit_code(&output), 1);
    assert_eq!(output_text(&output).matches("✗ fail  paper/").count(), 11, "{}", output_text(&output));
    let line = "trial 0: amplitude_um is 2.33 µm at 2 ms, 0.6989 µm outside ± 0.01795 µm around 1.59 µm";
    assert!(output_text(&output).contains(line), "{}", output_text(&output));
    let svg = fs::read_to_string(folder.path().join("run/comparison/paper/fig13-closed-loop.svg")).unwrap();
    assert!(svg.contains("amplitude_um at 2 ms"));
}

/// What people look at first, of the first trial of each scenario.
#[test]
fn features_of_the_paper_s_scenarios() {
    let folder = tempfile::tempdir().unwrap();
    play_paper(folder.path(), &[]);
    let run = folder.path().join("run");
    let mut table = String::new();
    for scenario in RunRecord::read(&run).unwrap().scenarios {
        let features =
            ResponseFeatures::of(&platebench_trace::read_trace(&run.join(&scenario.trials[0].trace)).unwrap());
        let said = features.by_name().map(|(name, value)| {
            format!("{name} {}", value.map_or_else(|| "none".to_owned(), |value| value.to_string()))
        });
        writeln!(table, "{}: {}", scenario.file, said.join(", ")).unwrap();
    }
    insta::assert_snapshot!(table);
}

/// A run of one step scenario in a workshop of its own.
fn step_run(trials: &str, plate: &str) -> TestFolder {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &(step_scenario(plate, "", "", GOOD) + trials));
    play(&workshop, "run");
    workshop
}

fn play(workshop: &TestFolder, out: &str) {
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", out]);
}

fn two_runs(workshop: &TestFolder) -> [PathBuf; 2] {
    ["toml", "csv"].map(|extension| workshop.path().join(format!("scenarios/baselines/s.{extension}")))
}

#[test]
fn an_accepted_baseline_is_listed_and_compared() {
    let workshop = step_run("", "aluminium-198x138");
    let ask = |arguments: &[&str]| run_bench(workshop.path(), arguments);
    assert_eq!(exit_code(&ask(&["compare", "run", "--against", "baseline"])), 3, "there is no baseline yet");
    let output = ask(&["baseline", "diff", "run"]);
    assert_eq!((exit_code(&output), output_text(&output).as_str()), (3, "? new  s.toml\n"));
    assert!(!two_runs(&workshop)[0].exists(), "a review writes nothing");
    let output = ask(&["baseline", "accept", "run"]);
    assert_eq!(exit_code(&output), 0);
    assert!(
        output_text(&output).starts_with("✓ accepted  s.toml  (new, settling_time_ms 1.96,"),
        "{}",
        output_text(&output)
    );
    assert_eq!(output_text(&ask(&["baseline", "accept", "run"])), "✓ unchanged  s.toml\n");
    for arguments in [&["baseline", "list"][..], &["baseline", "list", "run"]] {
        let output = ask(arguments);
        assert_eq!(exit_code(&output), 0);
        assert!(output_text(&output).starts_with("✓ s.toml: dq-pi, settling_time_ms 1.96"), "{}", output_text(&output));
    }
    for against in ["baseline", "run", "scenarios/baselines/s.toml", "run/traces/s/000.csv"] {
        for subject in ["run", "run/traces/s/000.csv"] {
            let output = ask(&["compare", subject, "--against", against]);
            assert_eq!(exit_code(&output), 0, "{subject} {against}: {}", output_text(&output));
        }
    }
    // Baselines lie below the scenarios and are none.
    play(&workshop, "again");
    assert_eq!(RunRecord::read(&workshop.path().join("again")).unwrap().scenarios.len(), 1);
}

#[test]
fn a_change_is_shown_before_it_is_accepted() {
    let workshop = step_run("", "aluminium-198x138");
    let ask = |arguments: &[&str]| run_bench(workshop.path(), arguments);
    ask(&["baseline", "accept", "run"]);
    let [head, table] = two_runs(&workshop);
    let (text, before) = (fs::read_to_string(&head).unwrap(), fs::read(&table).unwrap());
    fs::write(&head, text.replacen("absolute = 0.01", "absolute = 0.0123", 1)).unwrap();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "response_time_ms = 1.8", "", GOOD));
    play(&workshop, "other");
    let output = ask(&["baseline", "diff", "other"]);
    assert_eq!(exit_code(&output), 1);
    for said in ["✗ fail  s.toml", "trial 0: ", "settling_time_ms: 1.96 → 1.", "drive_peak_vpp: 551 → "] {
        assert!(output_text(&output).contains(said), "{said}: {}", output_text(&output));
    }
    assert_eq!(fs::read(&table).unwrap(), before);
    let output = ask(&["baseline", "accept", "other"]);
    assert!(
        output_text(&output).contains("✓ accepted  s.toml\n")
            && output_text(&output).contains("drive_peak_vpp: 551 → ")
    );
    assert_ne!(fs::read(&table).unwrap(), before);
    assert!(fs::read_to_string(&head).unwrap().contains("absolute = 0.0123"));
    assert_eq!(exit_code(&ask(&["compare", "other", "--against", "baseline"])), 0);
    assert_eq!(exit_code(&ask(&["compare", "run", "--against", "baseline"])), 1);
    assert_eq!(exit_code(&ask(&["compare", "run", "--against", "other"])), 1);
}

#[test]
fn a_failed_run_is_not_accepted_as_a_baseline() {
    let workshop = TestFolder::new();
    workshop.write_scenario(
        "s.toml",
        &step_scenario("aluminium-198x138", "", "", "metric = \"settling_time_ms\"\nat_most = 1.9"),
    );
    play(&workshop, "run");
    let output = run_bench(workshop.path(), ["baseline", "accept", "run"]);
    assert_eq!(exit_code(&output), 1);
    assert!(output_text(&output).contains("✗ not accepted  s.toml: it did not pass (fail)"));
    assert!(!workshop.path().join("scenarios/baselines").exists());
}

const VARIED: &str = "[trials]\ncount = 30\n[trials.spread]\nsensor_gain_percent = 0.2\ntime_constant_percent = 1.0\n";

#[test]
fn a_tube_is_learned_from_varying_trials() {
    let workshop = TestFolder::new();
    let expect = "metric = \"settling_time_ms\"\nat_most = 6.0\nover = \"mean\"";
    workshop.write_scenario("s.toml", &(step_scenario("aluminium-198x138-noisy", "", "", expect) + VARIED));
    play(&workshop, "run");
    let ask = |arguments: &[&str]| run_bench(workshop.path(), arguments);
    let output = ask(&["baseline", "accept", "run", "--false-alarm-rate", "0.01"]);
    assert_eq!(exit_code(&output), 2);
    assert!(
        output_text(&output).contains("a false-alarm rate of 0.01 needs at least 148 trials, this run has 30"),
        "{}",
        output_text(&output)
    );
    assert_eq!(exit_code(&ask(&["baseline", "accept", "run"])), 0);
    let head = fs::read_to_string(&two_runs(&workshop)[0]).unwrap();
    assert!(head.contains("[learned]\ntrials = 30\nfalse_alarm_rate = 0.05"), "{head}");
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "other", "--seed", "1000"]);
    let output = ask(&["compare", "other", "--against", "baseline"]);
    assert_ne!(exit_code(&output), 1, "{}", output_text(&output));
    // The same seeds give the same noise, other ones do not.
    assert_eq!(exit_code(&ask(&["compare", "run", "--against", "run"])), 0);
    assert_eq!(exit_code(&ask(&["compare", "other", "--against", "run"])), 1);
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "few", "--trials", "3"]);
    assert_eq!(exit_code(&ask(&["compare", "few", "--against", "run"])), 0);
    let output = ask(&["compare", "run", "--against", "few"]);
    assert_eq!(exit_code(&output), 3);
    assert!(output_text(&output).contains("the reference has no trial 3"), "{}", output_text(&output));
}

#[rstest]
#[case::no_subject(&["compare", "nowhere", "--against", "run"], "nowhere")]
#[case::no_reference(&["compare", "run", "--against", "nowhere"], "nowhere")]
#[case::no_against(&["compare", "run"], "--against")]
#[case::no_scenario(&["compare", "loose.csv", "--against", "baseline"], "has no scenario")]
#[case::half_a_trace(&["compare", "half.csv", "--against", "run/traces/s/000.csv"], "half.csv:1: columns")]
#[case::other_columns(&["compare", "run", "--against", "half.csv"], "half.csv:1: columns")]
#[case::rate(&["baseline", "accept", "run", "--false-alarm-rate", "0"], "expected a share")]
#[case::no_run(&["baseline", "diff", "nowhere"], "nowhere")]
#[case::no_folder(&["baseline", "list", "--baselines", "nowhere"], "nowhere")]
#[case::broken(&["compare", "run", "--against", "broken.toml"], "broken.toml:1:")]
fn wrong_usage_names_the_argument(#[case] arguments: &[&str], #[case] named: &str) {
    let workshop = step_run("", "aluminium-198x138");
    let trace = workshop.path().join("run/traces/s/000.csv");
    fs::copy(&trace, workshop.path().join("loose.csv")).unwrap();
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(workshop.path().join("half.csv"), text.replace("setpoint_um,", "")).unwrap();
    fs::write(workshop.path().join("broken.toml"), "colour = 1\n").unwrap();
    fs::write(workshop.path().join("broken.csv"), "t_ms\n").unwrap();
    let output = run_bench(workshop.path(), arguments);
    assert_eq!(exit_code(&output), 2, "{}", output_text(&output));
    assert!(output_text(&output).contains(named), "{}", output_text(&output));
}

#[test]
fn a_trace_of_another_length_is_inconclusive() {
    let workshop = step_run("", "aluminium-198x138");
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    let count = text.lines().count();
    let short = text.lines().take(count - 10).collect::<Vec<_>>().join("\n");
    fs::write(workshop.path().join("short.csv"), short + "\n").unwrap();
    for pair in [["short.csv", "run"], ["run", "short.csv"]] {
        let output = run_bench(workshop.path(), ["compare", pair[0], "--against", pair[1]]);
        assert_eq!(exit_code(&output), 3, "{}", output_text(&output));
        assert!(output_text(&output).contains("ms, the baseline from 0 to"), "{}", output_text(&output));
    }
}

#[test]
fn json_equals_the_text() {
    let workshop = step_run("", "aluminium-198x138");
    let output = run_bench(workshop.path(), ["compare", "run", "--against", "run", "--format", "json"]);
    let shown: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&shown[0]["scenario"], &shown[0]["verdict"]), (&"s.toml".into(), &"pass".into()));
}

/// What is accepted, and what is compared, is what the run was judged by.
#[test]
fn a_tampered_trace_is_neither_accepted_nor_compared() {
    let workshop = step_run("", "aluminium-198x138");
    assert_eq!(exit_code(&run_bench(workshop.path(), ["baseline", "accept", "run"])), 0);
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(&trace, text.replacen("control", "", 1)).unwrap();
    for command in [&["baseline", "accept", "run"][..], &["compare", "run", "--against", "baseline"]] {
        let output = run_bench(workshop.path(), command);
        assert_eq!(exit_code(&output), 2, "{}", output_text(&output));
        assert!(output_text(&output).contains("000.csv: SHA-256"), "{}", output_text(&output));
    }
}

/// What was not played cannot look different: nobody should have to count.
#[test]
fn missing_trials_are_reported() {
    let workshop =
        step_run("[trials]\ncount = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n", "aluminium-198x138-noisy");
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "few", "--trials", "1"]);
    let output = run_bench(workshop.path(), ["compare", "few", "--against", "run"]);
    assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
    assert!(output_text(&output).contains("s.toml: 1 of the 3 trials that run has"), "{}", output_text(&output));
    assert!(!output_text(&run_bench(workshop.path(), ["compare", "run", "--against", "run"])).contains("trials that"));
}
