//! Tests outputs for other programs and exports of a run.

use crate::test_folder::{ProgramOutput, SETTLING, TestFolder};
use rstest::rstest;
use serde_json::Value;
use std::fs;

const TRACE: &str = "run/traces/s/000.csv";

fn json_lines(output: &ProgramOutput) -> Vec<Value> {
    let parse = |line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
    output.stdout.lines().map(parse).collect()
}

fn stored_record(folder: &TestFolder) -> Value {
    serde_json::from_str(&folder.read("run/run.json")).unwrap()
}

#[test]
fn json_lines_end_with_the_verdict() {
    let folder = TestFolder::with_step(SETTLING);
    let run = ["run", "--rig", "hosted", "--trials", "2", "--jobs", "1", "--format", "json", "--out", "run"];
    let lines = json_lines(&folder.bench(run).assert_exit(0));
    assert_eq!(
        lines.iter().map(|line| line["event"].as_str().unwrap()).collect::<Vec<_>>(),
        ["run-started", "scenario-started", "trial-finished", "trial-finished", "scenario-finished", "run-finished"]
    );
    let record = stored_record(&folder);
    let scenario = &record["scenarios"][0];
    assert_eq!(lines[0]["folder"], "run");
    assert_eq!(lines[0]["scenarios"], serde_json::json!([{"scenario": "s.toml", "trials": 2}]));
    assert_eq!(lines[2]["trial"], scenario["trials"][0]);
    assert_eq!(lines[3]["trial"], scenario["trials"][1]);
    assert_eq!(lines[4]["expectations"], scenario["expectations"]);
    assert_eq!((&lines[5]["verdict"], &lines[5]["exit_code"]), (&record["verdict"], &Value::from(0)));
}

/// The code generator of the emulator logs 380,000 lines of details.
#[rstest]
#[case::steps("-v", "run starts", 18)]
#[case::details("-vv", "DEBUG platebench", 21)]
fn verbose_output_on_the_emulated_chip_is_bounded(#[case] option: &str, #[case] text: &str, #[case] expected: usize) {
    let folder = TestFolder::with_step(SETTLING);
    let output = folder.bench(["run", "--rig", "emulated", option, "--out", "run"]).assert_exit(0);
    let lines = output.text().lines().count();
    assert!((expected / 2..2 * expected).contains(&lines), "{lines} lines");
    output.assert_output(&[text]);
}

#[test]
fn the_version_lists_the_features() {
    let folder = TestFolder::new();
    folder.bench(["--version"]).assert_exit(0).assert_stdout(&["features: analysis, emulated, export, live"]);
}

#[test]
fn complete_trials_of_a_killed_run_are_exported() {
    let folder = TestFolder::with_step(SETTLING);
    folder.bench(["run", "--rig", "hosted", "--trials", "2", "--out", "run"]).assert_exit(0);
    let mut record = stored_record(&folder);
    record["complete"] = Value::from(false);
    record["scenarios"][0]["trials"] = Value::Array(Vec::new());
    record["scenarios"][0]["expectations"] = Value::Array(Vec::new());
    folder.write("run/run.json", &record.to_string());
    let traces = folder.join("run/traces/s");
    fs::rename(traces.join("001.csv"), traces.join("001.csv.part")).unwrap();
    folder
        .bench(["report", "run", "--export", "csv"])
        .assert_message(0, &["the run was interrupted; only its complete trials were exported"]);
    let table = folder.read("run/export/traces.csv");
    assert_eq!(table.lines().count(), folder.read(TRACE).lines().count());
    assert!(table.lines().skip(1).all(|line| line.starts_with("s,0,")));
    fs::remove_file(folder.join(TRACE)).unwrap();
    folder.bench(["report", "run", "--export", "csv", "--out", "other"]).assert_exit(4);
}

#[test]
fn an_old_summary_does_not_stand_beside_a_run_without_a_verdict() {
    let folder = TestFolder::with_step(SETTLING);
    let run = |out: &str, rig: &str| folder.bench(["run", "--rig", rig, "--summary", "s.md", "--out", out]);
    run("first", "hosted").assert_exit(0);
    let first = folder.read("s.md");
    assert!(!folder.exists("s.md.previous"));
    run("lost", "tcp:127.0.0.1:1").assert_exit(5);
    assert_eq!((folder.exists("s.md"), folder.read("s.md.previous")), (false, first));
    run("second", "hosted").assert_exit(0);
    assert!(folder.exists("s.md"));
}
