//! Tests outputs for other programs and exports of a run.

use crate::test_folder::{ProgramOutput, SETTLING, TestFolder, bench_command, step_text};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::io::Write;
use std::process::Stdio;

const BAD: &str = "metric = \"settling_time_ms\"\nat_most = 0.5\nrequirement = \"ACC-1\"";
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

#[rstest]
#[case::failed(Some(step_text(BAD)), "hosted", 1)]
#[case::invalid(Some("title = 3".to_owned()), "hosted", 2)]
#[case::absent_rig(Some(step_text(SETTLING)), "exec:true {port}", 5)]
#[case::no_scenario(None, "hosted", 4)]
fn the_last_line_is_written_on_every_exit(#[case] text: Option<String>, #[case] rig: &str, #[case] expected: i32) {
    let folder = TestFolder::new();
    if let Some(text) = text {
        folder.write_scenario("s.toml", &text);
    }
    let output = folder.bench(["run", "--rig", rig, "--format", "json", "--out", "run"]).assert_exit(expected);
    let lines = json_lines(&output);
    let last = lines.last().unwrap();
    assert_eq!((&last["event"], &last["exit_code"]), (&Value::from("run-finished"), &Value::from(expected)));
    assert_eq!(last["error"].is_null(), expected == 1, "{last}");
    assert_ne!(last["verdict"], "pass");
}

#[rstest]
#[case::elsewhere(&[], None, false)]
#[case::variable_false(&[], Some("false"), false)]
#[case::off(&["--github", "off"], Some("true"), false)]
#[case::variable(&[], Some("true"), true)]
#[case::on(&["--github", "on"], None, true)]
fn github_annotations_point_at_the_expectation(
    #[case] more: &[&str],
    #[case] variable: Option<&str>,
    #[case] annotates: bool,
) {
    let text = format!("{}\n[[expect]]\n{BAD}\n", step_text(SETTLING));
    let folder = TestFolder::with_scenario(&text);
    let line = text.lines().position(|line| line == "at_most = 0.5").unwrap();
    let expected = format!("::error file=scenarios/s.toml,line={line},title=s.toml%3A fail::settling_time_ms 2 ≤ 0.5");
    let mut command = bench_command(folder.path());
    command.args(["run", "--rig", "hosted", "--out", "run"]).args(more).env("GITHUB_STEP_SUMMARY", "step.md");
    command.envs(variable.map(|value| ("GITHUB_ACTIONS", value)));
    let output = ProgramOutput::from(command.output().unwrap()).assert_exit(1);
    assert_eq!(output.stderr.lines().any(|line| line.starts_with(&expected)), annotates, "{}", output.stderr);
    assert_eq!(folder.exists("step.md"), annotates);
}

#[test]
fn a_passed_run_prints_a_summary_and_no_progress() {
    let folder = TestFolder::with_step(SETTLING);
    fs::create_dir(folder.join("scenarios/limits")).unwrap();
    let limit = step_text(BAD).replace("\"plates/", "\"../plates/");
    folder.write_scenario("limits/limit.toml", &format!("only_if_named = \"known limit\"\n{limit}"));
    let output = folder.run_hosted("run").assert_exit(0);
    let stdout = output.stdout.replace(|digit: char| digit.is_ascii_digit(), "#");
    assert_eq!(
        stdout.lines().map(|line| line.split_once(": ").map_or(line, |(name, _)| name)).collect::<Vec<_>>(),
        ["tested", "# scenario", "# expectation", "duration", "smallest margin", "verdict"]
    );
    assert!(output.stdout.contains(" %, s.toml: settling_time_ms: "), "{}", output.stdout);
    let skipped =
        "1 scenario with `only_if_named` skipped (known limit 1); name a file or its folder to play it; -v lists them";
    assert_eq!(output.stderr, format!("{skipped}\nrun folder: run\nreport: run/report.html\n"));
}

#[test]
fn verbose_output_has_the_tables() {
    const ROW: &str = "  settling_time_ms  ✓ pass   1.9";
    let folder = TestFolder::with_step(SETTLING);
    assert!(!folder.run_hosted("short").assert_exit(0).stdout.contains(ROW));
    folder.bench(["run", "--rig", "hosted", "--out", "run", "-v"]).assert_exit(0).assert_stdout(&[ROW]);
    folder.bench(["report", "run", "--rejudge", "-v"]).assert_exit(0).assert_stdout(&[ROW]);
}

#[test]
fn quiet_output_has_failures_only() {
    let folder = TestFolder::with_step(SETTLING);
    let run = |out: &str| folder.bench(["run", "--rig", "hosted", "--quiet", "--out", out]);
    assert_eq!(run("good").assert_exit(0).text(), "");
    folder.write_scenario("bad.toml", &step_text(BAD));
    let output = run("run").assert_exit(1);
    let tested = format!(
        "tested: platebench-host {}, build unknown (the bench's own firmware); rig hosted; clock lockstep; law dq-pi; \
         plate aluminium-198x138; model modal\n",
        env!("CARGO_PKG_VERSION")
    );
    assert_eq!(
        output.stdout.strip_prefix(&tested).unwrap_or_else(|| panic!("{}", output.stdout)),
        "verdict: ✗ fail (the bench's own firmware on the rig hosted; name yours with --rig)\n\n\
         not passed:\n  ✗ bad.toml: settling_time_ms: 1.956 ms, limit ≤ 0.5, window 0 … 60 ms\n    \
         trace: traces/bad/000.csv\n"
    );
    assert_eq!(output.stderr, "run folder: run\nreport: run/report.html\n");
}

#[test]
fn summary_and_tap_are_files() {
    let folder = TestFolder::with_step(BAD);
    folder
        .bench(["run", "--rig", "hosted", "--out", "run", "--summary", "summary.md", "--tap", "run.tap"])
        .assert_exit(1);
    let summary = folder.read("summary.md");
    assert!(summary.starts_with("## ✗ platebench: fail\n") && summary.contains("ACC-1"), "{summary}");
    let tap = folder.read("run.tap");
    assert!(tap.starts_with("TAP version 13\n1..1\n") && tap.ends_with("\nnot ok 1 - s.toml\n"), "{tap}");
    let newer = ["run", "--rig", "hosted", "--out", "newer", "--tap", "newer.tap", "--tap-version", "14"];
    folder.bench(newer).assert_exit(1);
    assert_eq!(folder.read("newer.tap"), tap.replacen("13", "14", 1));
    folder.bench(["run", "--rig", "hosted", "--out", "again", "--tap", "no/such/folder"]).assert_exit(2);
}

#[test]
fn a_run_is_exported_once() {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("run").assert_exit(0);
    for (format, file) in [("parquet", "s.parquet"), ("mf4", "s.mf4"), ("csv", "traces.csv"), ("mcap", "s.mcap")] {
        let export = || folder.bench(["report", "run", "--export", format]);
        let output = export().assert_exit(0);
        assert!(output.stdout.starts_with(&format!("run/export/{file}\n")), "{}", output.stdout);
        let path = folder.join("run/export").join(file);
        let before = fs::read(&path).unwrap();
        export().assert_exit(2);
        assert_eq!(fs::read(&path).unwrap(), before);
    }
    for wrong in [&["report", "run", "--export", "csv", "t"][..], &["report", "nothing", "--export", "csv"]] {
        folder.bench(wrong).assert_exit(2);
    }
    folder.replace(TRACE, "\n0.0,", "\nx,");
    folder
        .bench(["report", "run", "--export", "parquet", "--out", "other"])
        .assert_message(2, &["run/traces/s/000.csv: SHA-256"]);
    assert!(!folder.exists("other"));
}

#[test]
fn a_tampered_trace_is_not_exported() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    folder.run_hosted("run").assert_exit(0);
    folder.tamper_with_trace();
    for (format, scenarios, expected) in [
        ("csv", &[][..], 2),
        ("parquet", &["s"], 2),
        ("mf4", &["t", "s.toml"], 2),
        ("mcap", &["s"], 2),
        ("parquet", &["t"], 0),
    ] {
        let output = folder.bench([&["report", "run", "--export", format], scenarios].concat()).assert_exit(expected);
        assert_eq!(output.stderr.contains("run/traces/s/000.csv: SHA-256"), expected == 2, "{}", output.stderr);
    }
    assert_eq!(fs::read_dir(folder.join("run/export")).unwrap().count(), 1);
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
fn a_dash_is_standard_input_and_output() {
    let folder = TestFolder::with_step(SETTLING);
    let text = folder.read("scenarios/s.toml");
    let call = |arguments: &[&str]| -> ProgramOutput {
        let mut bench = bench_command(&folder.join("scenarios"));
        bench.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = bench.spawn().unwrap();
        // The write fails if the command refuses its arguments and ends without reading.
        let _ = child.stdin.take().unwrap().write_all(text.as_bytes());
        child.wait_with_output().unwrap().into()
    };
    call(&["check", "-"]).assert_exit(0).assert_stdout(&["1 scenario"]);
    let run = ["run", "-", "--rig", "hosted", "--out", "../run"];
    let output = call(&[&run[..], &["--tap", "-"]].concat()).assert_exit(0);
    assert!(output.stdout.starts_with("TAP version 13\n1..1\n"), "{}", output.stdout);
    assert!(output.stdout.ends_with("ok 1 - stdin.toml\n"), "{}", output.stdout);
    assert!(output.stderr.contains("settling_time_ms"), "{}", output.stderr);
    assert_eq!(stored_record(&folder)["scenarios"][0]["file"], "stdin.toml");
    for second in [["--summary", "-"], ["--format", "json"]] {
        let arguments = [&run[..], &["--tap", "-"], &second].concat();
        call(&arguments).assert_message(2, &["standard output"]);
    }
}
