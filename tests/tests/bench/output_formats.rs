//! What a run tells other programs, and what is exported of it.

use crate::test_folder::{TestFolder, bench_command, exit_code, run_bench, step_scenario};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Output;

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";
const BAD: &str = "metric = \"settling_time_ms\"\nat_most = 0.5\nrequirement = \"ACC-1\"";

fn step_text(expect: &str) -> String {
    step_scenario("aluminium-198x138", "", "", expect)
}

fn json_lines(output: &Output) -> Vec<Value> {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))).collect()
}

fn event_names(lines: &[Value]) -> Vec<&str> {
    lines.iter().map(|line| line["event"].as_str().unwrap()).collect()
}

fn stored_record(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join("run/run.json")).unwrap()).unwrap()
}

#[test]
fn json_lines_end_with_the_verdict() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    let run = ["run", "--rig", "hosted", "--trials", "2", "--jobs", "1", "--format", "json", "--out", "run"];
    let output = run_bench(workshop.path(), run);
    assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
    let lines = json_lines(&output);
    assert_eq!(
        event_names(&lines),
        ["run-started", "scenario-started", "trial-finished", "trial-finished", "scenario-finished", "run-finished"]
    );
    let record = stored_record(workshop.path());
    let scenario = &record["scenarios"][0];
    assert_eq!(lines[0]["folder"], "run");
    assert_eq!(lines[0]["scenarios"], serde_json::json!([{"scenario": "s.toml", "trials": 2}]));
    assert_eq!(lines[2]["trial"], scenario["trials"][0]);
    assert_eq!(lines[3]["trial"], scenario["trials"][1]);
    assert_eq!(lines[4]["expectations"], scenario["expectations"]);
    assert_eq!((&lines[5]["verdict"], &lines[5]["exit_code"]), (&record["verdict"], &Value::from(0)));
}

#[test]
fn the_last_line_is_written_on_every_exit() {
    for (text, rig, expected) in [
        (step_text(BAD), "hosted", 1),
        ("title = 3".to_owned(), "hosted", 2),
        (step_text(GOOD), "exec:true {port}", 5),
        (String::new(), "hosted", 4),
    ] {
        let workshop = TestFolder::new();
        if !text.is_empty() {
            workshop.write_scenario("s.toml", &text);
        }
        let output = run_bench(workshop.path(), ["run", "--rig", rig, "--format", "json", "--out", "run"]);
        assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
        let lines = json_lines(&output);
        let last = lines.last().unwrap();
        assert_eq!((&last["event"], &last["exit_code"]), (&Value::from("run-finished"), &Value::from(expected)));
        assert_eq!(last["error"].is_null(), expected == 1, "{last}");
        assert_ne!(last["verdict"], "pass");
    }
}

#[test]
fn github_annotations_point_at_the_expectation() {
    let workshop = TestFolder::new();
    let text = format!("{}\n[[expect]]\n{BAD}\n", step_text(GOOD));
    workshop.write_scenario("s.toml", &text);
    let line = text.lines().position(|line| line == "at_most = 0.5").unwrap();
    let expected = format!("::error file=scenarios/s.toml,line={line},title=s.toml%3A fail::settling_time_ms 2 ≤ 0.5");
    let run = |out: &str, more: &[&str], on_github: Option<&str>| {
        let mut command = bench_command(workshop.path());
        command.args(["run", "--rig", "hosted", "--out", out]).args(more).env("GITHUB_STEP_SUMMARY", "step.md");
        if let Some(value) = on_github {
            command.env("GITHUB_ACTIONS", value);
        }
        let output = command.output().unwrap();
        assert_eq!(exit_code(&output), 1);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        (told.lines().any(|line| line.starts_with(&expected)), workshop.path().join("step.md").exists())
    };
    assert_eq!(run("a", &[], None), (false, false));
    assert_eq!(run("b", &[], Some("false")), (false, false));
    assert_eq!(run("c", &["--github", "off"], Some("true")), (false, false));
    assert_eq!(run("d", &[], Some("true")), (true, true));
    fs::remove_file(workshop.path().join("step.md")).unwrap();
    assert_eq!(run("e", &["--github", "on"], None), (true, true));
}

#[test]
fn summary_and_tap_are_files() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(BAD));
    let output = run_bench(
        workshop.path(),
        ["run", "--rig", "hosted", "--out", "run", "--summary", "summary.md", "--tap", "run.tap"],
    );
    assert_eq!(exit_code(&output), 1);
    let summary = fs::read_to_string(workshop.path().join("summary.md")).unwrap();
    assert!(summary.starts_with("## ✗ platebench: fail\n") && summary.contains("ACC-1"), "{summary}");
    let tap = fs::read_to_string(workshop.path().join("run.tap")).unwrap();
    assert!(tap.starts_with("TAP version 14\n1..1\n") && tap.ends_with("\nnot ok 1 - s.toml\n"), "{tap}");
    let output = run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "again", "--tap", "no/such/folder"]);
    assert_eq!(exit_code(&output), 2);
}

/// A file that is not there, one that is in the way, a scenario that nobody knows.
#[test]
fn a_run_is_exported_once() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"])), 0);
    for (format, file) in [("parquet", "s.parquet"), ("mf4", "s.mf4"), ("csv", "traces.csv"), ("mcap", "s.mcap")] {
        let export = ["export", "run", "--format", format];
        let output = run_bench(workshop.path(), export);
        assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
        let written = workshop.path().join("run/export").join(file);
        assert!(String::from_utf8_lossy(&output.stdout).starts_with(&format!("run/export/{file}\n")));
        let before = fs::read(&written).unwrap();
        assert_eq!(exit_code(&run_bench(workshop.path(), export)), 2);
        assert_eq!(fs::read(&written).unwrap(), before);
    }
    for wrong in [&["export", "run", "--format", "csv", "t"][..], &["export", "nothing", "--format", "csv"]] {
        assert_eq!(exit_code(&run_bench(workshop.path(), wrong)), 2, "{wrong:?}");
    }
    let trace = workshop.path().join("run/traces/s/000.csv");
    let broken = fs::read_to_string(&trace).unwrap().replacen("\n0.0,", "\nx,", 1);
    fs::write(&trace, broken).unwrap();
    let output = run_bench(workshop.path(), ["export", "run", "--format", "parquet", "--out", "other"]);
    assert_eq!(exit_code(&output), 2);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("run/traces/s/000.csv: SHA-256"), "{told}");
    assert!(!workshop.path().join("other").exists(), "and nothing is written");
}

/// Of two scenarios one has a trace that was changed: neither both nor that one is exported, the other one is.
#[test]
fn a_tampered_trace_is_not_exported() {
    let workshop = TestFolder::new();
    for name in ["s.toml", "t.toml"] {
        workshop.write_scenario(name, &step_text(GOOD));
    }
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"])), 0);
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(&trace, text.replacen("control", "", 1)).unwrap();
    for (format, asked, expected) in [
        ("csv", &[][..], 2),
        ("parquet", &["s"][..], 2),
        ("mf4", &["t", "s.toml"][..], 2),
        ("mcap", &["s"][..], 2),
        ("parquet", &["t"][..], 0),
    ] {
        let output = run_bench(workshop.path(), [&["export", "run", "--format", format], asked].concat());
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(exit_code(&output), expected, "{format} {asked:?}: {told}");
        assert_eq!(told.contains("run/traces/s/000.csv: SHA-256"), expected == 2, "{format} {asked:?}: {told}");
    }
    assert_eq!(fs::read_dir(workshop.path().join("run/export")).unwrap().count(), 1);
}

/// A run that was killed: the record names no trial, one trace is whole and the next is not.
#[test]
fn complete_trials_of_a_killed_run_are_exported() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    let run = ["run", "--rig", "hosted", "--trials", "2", "--out", "run"];
    assert_eq!(exit_code(&run_bench(workshop.path(), run)), 0);
    let mut record = stored_record(workshop.path());
    record["complete"] = Value::from(false);
    record["scenarios"][0]["trials"] = Value::Array(Vec::new());
    record["scenarios"][0]["expectations"] = Value::Array(Vec::new());
    fs::write(workshop.path().join("run/run.json"), record.to_string()).unwrap();
    let traces = workshop.path().join("run/traces/s");
    fs::rename(traces.join("001.csv"), traces.join("001.csv.part")).unwrap();
    let output = run_bench(workshop.path(), ["export", "run", "--format", "csv"]);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(exit_code(&output), 0, "{told}");
    assert!(told.contains("the run was interrupted; exported are its complete trials"), "{told}");
    let table = fs::read_to_string(workshop.path().join("run/export/traces.csv")).unwrap();
    let rows = fs::read_to_string(traces.join("000.csv")).unwrap().lines().count();
    assert_eq!(table.lines().count(), rows);
    assert!(table.lines().skip(1).all(|line| line.starts_with("s,0,")));
    fs::remove_file(traces.join("000.csv")).unwrap();
    let output = run_bench(workshop.path(), ["export", "run", "--format", "csv", "--out", "other"]);
    assert_eq!(exit_code(&output), 4, "{}", String::from_utf8_lossy(&output.stderr));
}
