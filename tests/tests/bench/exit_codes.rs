//! Exit codes, and what is said beside them.

use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, exit_code, run_bench, step_scenario, wait_until, workspace_root,
};
use rstest::rstest;
use std::fs;
use std::io::Read;
use std::process::{Command, Stdio};

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";
const BAD: &str = "metric = \"settling_time_ms\"\nat_most = 1.9";

fn step_text(expect: &str) -> String {
    step_scenario("aluminium-198x138", "", "", expect)
}

#[rstest]
#[case::passed(GOOD, 0)]
#[case::failed(BAD, 1)]
#[case::inconclusive("metric = \"repeatability_percent\"\nat_most = 1.0", 3)]
fn verdicts_become_exit_codes(#[case] expect: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(expect));
    let output = run_bench(workshop.path(), ["run", "--out", "run"]);
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stdout));
    // The verdict is made again from the stored traces alone.
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), expected);
}

#[test]
fn a_failure_outweighs_an_inconclusive_verdict() {
    let workshop = TestFolder::new();
    workshop.write_scenario("a.toml", &step_text("metric = \"repeatability_percent\"\nat_most = 1.0"));
    workshop.write_scenario("b.toml", &step_text(BAD));
    workshop.write_scenario("c.toml", &step_text(GOOD));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run"])), 1);
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
fn a_pipe_as_input_is_rejected_without_waiting(#[case] arguments: &[&str]) {
    let workshop = TestFolder::new();
    let at = |name: &str| workshop.path().join(name);
    let good = step_text(GOOD).replace("plates/", "scenarios/plates/");
    fs::write(at("good.toml"), &good).unwrap();
    fs::write(at("plate.toml"), good.replace("scenarios/plates/aluminium-198x138.toml", "pipe.toml")).unwrap();
    fs::write(at("profile.toml"), good.replace("setpoint_um = 2.0", "setpoint_um = { csv = \"pipe.toml\" }")).unwrap();
    fs::create_dir(at("folder")).unwrap();
    for pipe in ["pipe.toml", "folder/pipe.toml"] {
        assert!(Command::new("mkfifo").arg(at(pipe)).status().unwrap().success());
    }
    let mut bench = bench_command(workshop.path());
    let bench =
        bench.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut bench = ChildGuard(bench);
    wait_until("a pipe is waited for", || bench.0.try_wait().unwrap().is_some());
    let mut told = String::new();
    bench.0.stderr.take().unwrap().read_to_string(&mut told).unwrap();
    assert_eq!(bench.0.wait().unwrap().code(), Some(2), "{told}");
    assert!(told.contains("pipe.toml") && told.contains("it is a pipe or a device, expected"), "{told}");
}

#[rstest]
#[case::table(&["run", "--rig", "hosted"])]
#[case::lines(&["run", "--rig", "hosted", "--format", "json"])]
#[case::schema(&["schema", "scenario"])]
fn a_write_error_is_not_a_success(#[case] arguments: &[&str]) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    let full = fs::File::create("/dev/full").unwrap();
    let output = bench_command(workshop.path()).args(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("standard output is incomplete: No space left"), "{told}");
}

#[test]
fn invalid_input_outweighs_all_and_nothing_runs() {
    let workshop = TestFolder::new();
    workshop.write_scenario("bad.toml", &step_text(BAD));
    workshop.write_scenario("broken.toml", &step_text(GOOD).replace("duration_ms", "duration"));
    let output = run_bench(workshop.path(), ["run", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
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
fn wrong_usage_names_the_argument(#[case] arguments: &[&str], #[case] named: &str) {
    let folder = tempfile::tempdir().unwrap();
    let output = run_bench(folder.path(), arguments);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains(named), "{told}");
    assert!(!told.contains("panicked"), "{told}");
}

#[test]
fn an_unknown_law_is_reported_with_its_line() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "law = \"dq-pid\"", "", GOOD));
    let output = run_bench(workshop.path(), ["run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("s.toml:5:7") && told.contains("`dq-pi`"), "{told}");
}

#[test]
fn a_run_without_scenarios_is_not_a_pass() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    assert_eq!(exit_code(&run_bench(folder.path(), ["run"])), 4);
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--shard", "2/2"])), 4);
}

/// Whoever names a folder expects something of it: what the others hold is no answer.
#[test]
fn a_named_folder_without_scenarios_is_not_a_pass() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    fs::create_dir(workshop.path().join("more")).unwrap();
    let output = run_bench(workshop.path(), ["run", "scenarios", "more", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 4, "{told}");
    assert!(told.contains("more: there is nothing to run below it"), "{told}");
    assert!(!workshop.path().join("run").exists(), "and nothing is played");
}

#[rstest]
#[case::skipped(&[], 4)]
#[case::required(&["--require-all"], 1)]
fn a_law_that_the_controller_lacks_is_not_applicable(#[case] options: &[&str], #[case] expected: i32) {
    let Some(python) = platebench_test_kit::python_with_pyserial() else { return };
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "law = \"deadbeat\"", "", GOOD));
    let controller = workspace_root().join("docs/examples/controller.py");
    let rig = format!("exec:{python} '{}' {{port}}", controller.display());
    let output = run_bench(workshop.path(), ["run", "--out", "run", "--rig", &rig].iter().chain(options));
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_run_folder_is_not_written_over() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--out", "run"])), 0);
    let before = fs::read(workshop.path().join("run/run.json")).unwrap();
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--out", "run"])), 2);
    assert_eq!(fs::read(workshop.path().join("run/run.json")).unwrap(), before);
}

#[test]
fn two_runs_into_one_folder_exclude_each_other() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD).replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let start = || {
        let mut bench = bench_command(workshop.path());
        bench.args(["run", "--rig", "hosted", "--trials", "200", "--out", "run"]);
        ChildGuard(bench.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    };
    let mut runs = [start(), start()];
    let ended = |run: &mut ChildGuard| run.0.try_wait().unwrap().map(|status| status.code());
    wait_until("neither run was rejected", || runs.iter_mut().any(|run| ended(run).is_some()));
    let codes = runs.each_mut().map(ended);
    assert!(codes.contains(&Some(Some(2))) && codes.contains(&None), "{codes:?}");
}

#[test]
fn an_unusable_rig_leaves_no_files() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    for (rig, told) in [("exec:true", "`true` has no {port}"), ("probe:STM32F407VG", "--features probe")] {
        let output = run_bench(workshop.path(), ["run", "--rig", rig]);
        assert_eq!(exit_code(&output), 2);
        assert!(String::from_utf8_lossy(&output.stderr).contains(told));
    }
    assert!(!workshop.path().join("runs").exists());
}

#[test]
fn a_closed_output_pipe_is_not_an_error() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    let mut child =
        bench_command(workshop.path()).arg("run").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn the_log_follows_its_switches() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_text(GOOD));
    let log = |arguments: &[&str], variable: Option<&str>| {
        let mut command = bench_command(workshop.path());
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
    let output =
        run_bench(&workspace_root(), ["run", "--trials", "2", "--out", "target/tests/default-run", "--shard", "7/40"]);
    let _ = fs::remove_dir_all(workspace_root().join("target/tests/default-run"));
    assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
}
