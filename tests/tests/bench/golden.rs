//! Golden traces: what was accepted of the paper's scenarios, and how that is reviewed.

use crate::bench::{Workshop, call, code, root, step_scenario};
use platebench_verdict::RunRecord;
use platebench_verdict::golden::Features;
use rstest::rstest;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

fn baselines() -> String {
    root().join("scenarios/baselines").display().to_string()
}

fn play_paper(folder: &Path, more: &[&str]) {
    let paper = root().join("scenarios/paper");
    call(folder, ["run", paper.to_str().unwrap(), "--rig", "hosted", "--out", "run"].iter().chain(more));
}

#[test]
fn the_paper_s_scenarios_look_as_they_were_accepted() {
    let folder = tempfile::tempdir().unwrap();
    play_paper(folder.path(), &[]);
    let output = call(folder.path(), ["compare", "run", "--against", "baseline", "--baselines", &baselines()]);
    assert_eq!(code(&output), 0, "{}", told(&output));
    assert_eq!(told(&output).matches("✓ pass  paper/").count(), 11);
    assert!(!folder.path().join("run/comparison").exists(), "there is nothing to draw");
}

#[test]
fn another_law_is_found_in_every_scenario_and_drawn() {
    let folder = tempfile::tempdir().unwrap();
    play_paper(folder.path(), &["--law", "dq-pi-euler"]);
    let output = call(folder.path(), ["compare", "run", "--against", "baseline", "--baselines", &baselines()]);
    assert_eq!(code(&output), 1);
    assert_eq!(told(&output).matches("✗ fail  paper/").count(), 11, "{}", told(&output));
    let line = "trial 0: amplitude_um is 2.33 µm at 2 ms, 0.6989 µm outside ± 0.01795 µm around 1.59 µm";
    assert!(told(&output).contains(line), "{}", told(&output));
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
        let features = Features::of(&platebench_trace::read(&run.join(&scenario.trials[0].trace)).unwrap());
        let said = features.named().map(|(name, value)| {
            format!("{name} {}", value.map_or_else(|| "none".to_owned(), |value| value.to_string()))
        });
        writeln!(table, "{}: {}", scenario.file, said.join(", ")).unwrap();
    }
    insta::assert_snapshot!(table);
}

/// A run of one step scenario in a workshop of its own.
fn step_run(trials: &str, plate: &str) -> Workshop {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &(step_scenario(plate, "", "", GOOD) + trials));
    play(&workshop, "run");
    workshop
}

fn play(workshop: &Workshop, out: &str) {
    call(workshop.path(), ["run", "--rig", "hosted", "--out", out]);
}

fn pair(workshop: &Workshop) -> [PathBuf; 2] {
    ["toml", "csv"].map(|extension| workshop.path().join(format!("scenarios/baselines/s.{extension}")))
}

#[test]
fn what_is_accepted_is_listed_compared_and_not_written_twice() {
    let workshop = step_run("", "aluminium-198x138");
    let ask = |arguments: &[&str]| call(workshop.path(), arguments);
    assert_eq!(code(&ask(&["compare", "run", "--against", "baseline"])), 3, "there is no baseline yet");
    let output = ask(&["baseline", "diff", "run"]);
    assert_eq!((code(&output), told(&output).as_str()), (3, "? new  s.toml\n"));
    assert!(!pair(&workshop)[0].exists(), "a review writes nothing");
    let output = ask(&["baseline", "accept", "run"]);
    assert_eq!(code(&output), 0);
    assert!(told(&output).starts_with("✓ accepted  s.toml  (new, settling_time_ms 1.96,"), "{}", told(&output));
    assert_eq!(told(&ask(&["baseline", "accept", "run"])), "✓ unchanged  s.toml\n");
    for arguments in [&["baseline", "list"][..], &["baseline", "list", "run"]] {
        let output = ask(arguments);
        assert_eq!(code(&output), 0);
        assert!(told(&output).starts_with("✓ s.toml: dq-pi, settling_time_ms 1.96"), "{}", told(&output));
    }
    for against in ["baseline", "run", "scenarios/baselines/s.toml", "run/traces/s/000.csv"] {
        for subject in ["run", "run/traces/s/000.csv"] {
            let output = ask(&["compare", subject, "--against", against]);
            assert_eq!(code(&output), 0, "{subject} {against}: {}", told(&output));
        }
    }
    // Baselines lie below the scenarios and are none.
    play(&workshop, "again");
    assert_eq!(RunRecord::read(&workshop.path().join("again")).unwrap().scenarios.len(), 1);
}

#[test]
fn a_change_is_shown_before_it_is_accepted_and_tolerances_stay() {
    let workshop = step_run("", "aluminium-198x138");
    let ask = |arguments: &[&str]| call(workshop.path(), arguments);
    ask(&["baseline", "accept", "run"]);
    let [head, table] = pair(&workshop);
    let (text, before) = (fs::read_to_string(&head).unwrap(), fs::read(&table).unwrap());
    fs::write(&head, text.replacen("absolute = 0.01", "absolute = 0.0123", 1)).unwrap();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "response_time_ms = 1.8", "", GOOD));
    play(&workshop, "other");
    let output = ask(&["baseline", "diff", "other"]);
    assert_eq!(code(&output), 1);
    for said in ["✗ fail  s.toml", "trial 0: ", "settling_time_ms: 1.96 → 1.", "drive_peak_vpp: 551 → "] {
        assert!(told(&output).contains(said), "{said}: {}", told(&output));
    }
    assert_eq!(fs::read(&table).unwrap(), before);
    let output = ask(&["baseline", "accept", "other"]);
    assert!(told(&output).contains("✓ accepted  s.toml\n") && told(&output).contains("drive_peak_vpp: 551 → "));
    assert_ne!(fs::read(&table).unwrap(), before);
    assert!(fs::read_to_string(&head).unwrap().contains("absolute = 0.0123"));
    assert_eq!(code(&ask(&["compare", "other", "--against", "baseline"])), 0);
    assert_eq!(code(&ask(&["compare", "run", "--against", "baseline"])), 1);
    assert_eq!(code(&ask(&["compare", "run", "--against", "other"])), 1);
}

#[test]
fn what_did_not_pass_is_not_accepted() {
    let workshop = Workshop::new();
    workshop.scenario(
        "s.toml",
        &step_scenario("aluminium-198x138", "", "", "metric = \"settling_time_ms\"\nat_most = 1.9"),
    );
    play(&workshop, "run");
    let output = call(workshop.path(), ["baseline", "accept", "run"]);
    assert_eq!(code(&output), 1);
    assert!(told(&output).contains("✗ not accepted  s.toml: it did not pass (fail)"));
    assert!(!workshop.path().join("scenarios/baselines").exists());
}

const VARIED: &str = "[trials]\ncount = 30\n[trials.spread]\nsensor_gain_percent = 0.2\ntime_constant_percent = 1.0\n";

#[test]
fn a_tube_is_learned_where_trials_differ() {
    let workshop = Workshop::new();
    let expect = "metric = \"settling_time_ms\"\nat_most = 6.0\nover = \"mean\"";
    workshop.scenario("s.toml", &(step_scenario("aluminium-198x138-noisy", "", "", expect) + VARIED));
    play(&workshop, "run");
    let ask = |arguments: &[&str]| call(workshop.path(), arguments);
    let output = ask(&["baseline", "accept", "run", "--false-alarm-rate", "0.01"]);
    assert_eq!(code(&output), 2);
    assert!(told(&output).contains("0.01 takes at least 148 trials to learn from, there are 30"), "{}", told(&output));
    assert_eq!(code(&ask(&["baseline", "accept", "run"])), 0);
    let head = fs::read_to_string(&pair(&workshop)[0]).unwrap();
    assert!(head.contains("[learned]\ntrials = 30\nfalse_alarm_rate = 0.05"), "{head}");
    call(workshop.path(), ["run", "--rig", "hosted", "--out", "other", "--seed", "1000"]);
    let output = ask(&["compare", "other", "--against", "baseline"]);
    assert_ne!(code(&output), 1, "{}", told(&output));
    // The same seeds give the same noise, other ones do not.
    assert_eq!(code(&ask(&["compare", "run", "--against", "run"])), 0);
    assert_eq!(code(&ask(&["compare", "other", "--against", "run"])), 1);
    call(workshop.path(), ["run", "--rig", "hosted", "--out", "few", "--trials", "3"]);
    assert_eq!(code(&ask(&["compare", "few", "--against", "run"])), 0);
    let output = ask(&["compare", "run", "--against", "few"]);
    assert_eq!(code(&output), 3);
    assert!(told(&output).contains("trial 3 has none of its number"), "{}", told(&output));
}

#[rstest]
#[case::no_subject(&["compare", "nowhere", "--against", "run"], "nowhere")]
#[case::no_reference(&["compare", "run", "--against", "nowhere"], "nowhere")]
#[case::no_against(&["compare", "run"], "--against")]
#[case::no_scenario(&["compare", "loose.csv", "--against", "baseline"], "belongs to no scenario")]
#[case::half_a_trace(&["compare", "half.csv", "--against", "run/traces/s/000.csv"], "half.csv:1: columns")]
#[case::other_columns(&["compare", "run", "--against", "half.csv"], "half.csv:1: columns")]
#[case::rate(&["baseline", "accept", "run", "--false-alarm-rate", "0"], "expected a share")]
#[case::no_run(&["baseline", "diff", "nowhere"], "nowhere")]
#[case::no_folder(&["baseline", "list", "--baselines", "nowhere"], "nowhere")]
#[case::broken(&["compare", "run", "--against", "broken.toml"], "broken.toml:1:")]
fn wrong_usage_is_told_by_name(#[case] arguments: &[&str], #[case] named: &str) {
    let workshop = step_run("", "aluminium-198x138");
    let trace = workshop.path().join("run/traces/s/000.csv");
    fs::copy(&trace, workshop.path().join("loose.csv")).unwrap();
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(workshop.path().join("half.csv"), text.replace("setpoint_um,", "")).unwrap();
    fs::write(workshop.path().join("broken.toml"), "colour = 1\n").unwrap();
    fs::write(workshop.path().join("broken.csv"), "t_ms\n").unwrap();
    let output = call(workshop.path(), arguments);
    assert_eq!(code(&output), 2, "{}", told(&output));
    assert!(told(&output).contains(named), "{}", told(&output));
}

#[test]
fn a_trace_of_another_length_is_a_doubt() {
    let workshop = step_run("", "aluminium-198x138");
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    let count = text.lines().count();
    let short = text.lines().take(count - 10).collect::<Vec<_>>().join("\n");
    fs::write(workshop.path().join("short.csv"), short + "\n").unwrap();
    for pair in [["short.csv", "run"], ["run", "short.csv"]] {
        let output = call(workshop.path(), ["compare", pair[0], "--against", pair[1]]);
        assert_eq!(code(&output), 3, "{}", told(&output));
        assert!(told(&output).contains("ms, the baseline from 0 to"), "{}", told(&output));
    }
}

#[test]
fn json_says_the_same() {
    let workshop = step_run("", "aluminium-198x138");
    let output = call(workshop.path(), ["compare", "run", "--against", "run", "--format", "json"]);
    let shown: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&shown[0]["scenario"], &shown[0]["verdict"]), (&"s.toml".into(), &"pass".into()));
}

/// What is accepted, and what is compared, is what the run was judged by.
#[test]
fn a_doctored_trace_is_neither_accepted_nor_compared() {
    let workshop = step_run("", "aluminium-198x138");
    assert_eq!(code(&call(workshop.path(), ["baseline", "accept", "run"])), 0);
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(&trace, text.replacen("control", "", 1)).unwrap();
    for command in [&["baseline", "accept", "run"][..], &["compare", "run", "--against", "baseline"]] {
        let output = call(workshop.path(), command);
        assert_eq!(code(&output), 2, "{}", told(&output));
        assert!(told(&output).contains("000.csv: SHA-256"), "{}", told(&output));
    }
}

/// What was not played cannot look different: nobody should have to count.
#[test]
fn less_than_the_other_run_is_told() {
    let workshop =
        step_run("[trials]\ncount = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n", "aluminium-198x138-noisy");
    call(workshop.path(), ["run", "--rig", "hosted", "--out", "few", "--trials", "1"]);
    let output = call(workshop.path(), ["compare", "few", "--against", "run"]);
    assert_eq!(code(&output), 0, "{}", told(&output));
    assert!(told(&output).contains("s.toml: 1 of the 3 trials that run has"), "{}", told(&output));
    assert!(!told(&call(workshop.path(), ["compare", "run", "--against", "run"])).contains("trials that"));
}
