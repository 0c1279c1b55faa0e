//! Exit codes, and what is said beside them.

use crate::bench::{Guarded, Workshop, await_that, call, code, program, root, step_scenario};
use rstest::rstest;
use std::fs;
use std::io::Read;
use std::process::{Command, Stdio};

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";
const BAD: &str = "metric = \"settling_time_ms\"\nat_most = 1.9";

fn step(expect: &str) -> String {
    step_scenario("aluminium-198x138", "", "", expect)
}

#[rstest]
#[case::passed(GOOD, 0)]
#[case::failed(BAD, 1)]
#[case::inconclusive("metric = \"repeatability_percent\"\nat_most = 1.0", 3)]
fn verdicts_become_exit_codes(#[case] expect: &str, #[case] expected: i32) {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(expect));
    let output = call(workshop.path(), ["run", "--out", "run"]);
    assert_eq!(code(&output), expected, "{}", String::from_utf8_lossy(&output.stdout));
    // The verdict is made again from the stored traces alone.
    assert_eq!(code(&call(workshop.path(), ["judge", "run"])), expected);
}

#[test]
fn one_failure_outweighs_a_doubt() {
    let workshop = Workshop::new();
    workshop.scenario("a.toml", &step("metric = \"repeatability_percent\"\nat_most = 1.0"));
    workshop.scenario("b.toml", &step(BAD));
    workshop.scenario("c.toml", &step(GOOD));
    assert_eq!(code(&call(workshop.path(), ["run"])), 1);
}

/// Nobody writes into the pipe: whoever opens it waits for ever.
#[rstest]
#[case::scenario(&["run", "pipe.toml", "--rig", "hosted"])]
#[case::folder(&["run", "folder", "--rig", "hosted"])]
#[case::plate(&["run", "plate.toml", "--rig", "hosted"])]
#[case::profile(&["run", "profile.toml", "--rig", "hosted"])]
#[case::check(&["check", "pipe.toml"])]
#[case::tune(&["tune", "--plate", "pipe.toml"])]
#[case::firmware(&["run", "good.toml", "--rig", "emulated:pipe.toml"])]
#[case::plan(&["accept", "--rig", "hosted", "--plan", "pipe.toml"])]
fn a_pipe_is_no_input_and_is_not_waited_for(#[case] arguments: &[&str]) {
    let workshop = Workshop::new();
    let at = |name: &str| workshop.path().join(name);
    let good = step(GOOD).replace("plates/", "scenarios/plates/");
    fs::write(at("good.toml"), &good).unwrap();
    fs::write(at("plate.toml"), good.replace("scenarios/plates/aluminium-198x138.toml", "pipe.toml")).unwrap();
    fs::write(at("profile.toml"), good.replace("setpoint_um = 2.0", "setpoint_um = { csv = \"pipe.toml\" }")).unwrap();
    fs::create_dir(at("folder")).unwrap();
    for pipe in ["pipe.toml", "folder/pipe.toml"] {
        assert!(Command::new("mkfifo").arg(at(pipe)).status().unwrap().success());
    }
    let mut bench = program(workshop.path());
    let bench =
        bench.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut bench = Guarded(bench);
    await_that("a pipe is waited for", || bench.0.try_wait().unwrap().is_some());
    let mut told = String::new();
    bench.0.stderr.take().unwrap().read_to_string(&mut told).unwrap();
    assert_eq!(bench.0.wait().unwrap().code(), Some(2), "{told}");
    assert!(told.contains("pipe.toml") && told.contains("it is a pipe or a device, expected"), "{told}");
}

#[rstest]
#[case::table(&["run", "--rig", "hosted"])]
#[case::lines(&["run", "--rig", "hosted", "--format", "json"])]
#[case::schema(&["schema", "scenario"])]
fn a_result_that_could_not_be_written_is_no_success(#[case] arguments: &[&str]) {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    let full = fs::File::create("/dev/full").unwrap();
    let output = program(workshop.path()).args(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{told}");
    assert!(told.contains("standard output is not whole: No space left"), "{told}");
}

#[test]
fn invalid_input_outweighs_everything_and_runs_nothing() {
    let workshop = Workshop::new();
    workshop.scenario("bad.toml", &step(BAD));
    workshop.scenario("broken.toml", &step(GOOD).replace("duration_ms", "duration"));
    let output = call(workshop.path(), ["run", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{told}");
    assert!(told.contains("broken.toml:3:1"), "{told}");
    assert!(!workshop.path().join("run").exists());
}

#[rstest]
#[case::no_such_file(&["run", "no-such.toml"], "no-such.toml")]
#[case::no_default_folder(&["run"], "scenarios")]
#[case::unknown_law(&["run", "--law", "dq-pid"], "dq-pid")]
#[case::unknown_rig(&["run", "--rig", "can:0"], "can:0")]
#[case::no_trials(&["run", "--trials", "0"], "0")]
#[case::wrong_shard(&["run", "--shard", "3/2"], "3/2")]
#[case::no_command(&["frobnicate"], "frobnicate")]
#[case::no_run(&["judge", "nowhere"], "nowhere")]
#[case::no_report(&["report", "nowhere"], "nowhere")]
fn wrong_usage_is_told_by_name(#[case] arguments: &[&str], #[case] named: &str) {
    let folder = tempfile::tempdir().unwrap();
    let output = call(folder.path(), arguments);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{told}");
    assert!(told.contains(named), "{told}");
    assert!(!told.contains("panicked"), "{told}");
}

#[test]
fn a_scenario_s_unknown_law_is_pointed_at() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "law = \"dq-pid\"", "", GOOD));
    let output = call(workshop.path(), ["run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{told}");
    assert!(told.contains("s.toml:5:7") && told.contains("`dq-pi`"), "{told}");
}

#[test]
fn nothing_to_run_is_no_pass() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    assert_eq!(code(&call(folder.path(), ["run"])), 4);
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    assert_eq!(code(&call(workshop.path(), ["run", "--shard", "2/2"])), 4);
}

/// Whoever names a folder expects something of it: what the others hold is no answer.
#[test]
fn a_folder_that_was_named_for_nothing_is_no_pass() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    fs::create_dir(workshop.path().join("more")).unwrap();
    let output = call(workshop.path(), ["run", "scenarios", "more", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 4, "{told}");
    assert!(told.contains("more: there is nothing to run below it"), "{told}");
    assert!(!workshop.path().join("run").exists(), "and nothing is played");
}

#[test]
fn a_run_folder_is_not_written_over() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    assert_eq!(code(&call(workshop.path(), ["run", "--out", "run"])), 0);
    let before = fs::read(workshop.path().join("run/run.json")).unwrap();
    assert_eq!(code(&call(workshop.path(), ["run", "--out", "run"])), 2);
    assert_eq!(fs::read(workshop.path().join("run/run.json")).unwrap(), before);
}

#[test]
fn a_rig_that_cannot_be_used_leaves_nothing_behind() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    for (rig, told) in [("exec:true", "`true` has no {port}"), ("probe:STM32F407VG", "--features probe")] {
        let output = call(workshop.path(), ["run", "--rig", rig]);
        assert_eq!(code(&output), 2);
        assert!(String::from_utf8_lossy(&output.stderr).contains(told));
    }
    assert!(!workshop.path().join("runs").exists());
}

#[test]
fn a_reader_who_goes_away_is_no_error() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    let mut child = program(workshop.path()).arg("run").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn the_log_follows_its_switches() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step(GOOD));
    let log = |arguments: &[&str], variable: Option<&str>| {
        let mut command = program(workshop.path());
        command.args(["run"]).args(arguments);
        if let Some(value) = variable {
            command.env("PLATEBENCH_LOG", value);
        }
        String::from_utf8(command.output().unwrap().stderr).unwrap()
    };
    assert!(!log(&[], None).contains("scenario judged"));
    assert!(log(&["-v"], None).contains("scenario judged"));
    assert!(log(&[], Some("platebench_runner=info")).contains("scenario judged"));
    let json = log(&["-v", "--log-format", "json"], None);
    let line = json.lines().find(|line| line.contains("scenario judged")).unwrap();
    assert_eq!(serde_json::from_str::<serde_json::Value>(line).unwrap()["level"], "INFO");
}

#[test]
fn the_repository_s_default_run_needs_nothing_but_its_folder() {
    let output = call(&root(), ["run", "--trials", "2", "--out", "target/tests/default-run", "--shard", "1/40"]);
    let _ = fs::remove_dir_all(root().join("target/tests/default-run"));
    assert_eq!(code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
}
