//! Tests runs that a signal or a limit of the operating system ends.

use crate::test_folder::{
    ChildGuard, PROGRAM, TestFolder, bench_command, controller_rig, start_bench, step_scenario, wait_until,
};
use platebench_model::record::Cause;
use rstest::rstest;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;
use std::{env, fs};

fn long_folder() -> TestFolder {
    let expect = "metric = \"settling_time_ms\"\nat_most = 100.0";
    let text = step_scenario("aluminium-198x138-noisy", "", "", expect);
    let text = text.replace("duration_ms = 60.0", "duration_ms = 900.0");
    TestFolder::with_scenario(&(text + "[trials]\ncount = 100000\n"))
}

fn start_run(folder: &TestFolder) -> ChildGuard {
    let bench = start_bench(folder.path(), ["run", "--rig", "hosted", "--out", "run"]);
    wait_for_traces(folder);
    bench
}

fn complete_trace_count(folder: &TestFolder) -> usize {
    let entries = fs::read_dir(folder.join("run/traces/s")).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

fn wait_for_traces(folder: &TestFolder) {
    wait_until("no complete trial", || complete_trace_count(folder) >= 3);
}

fn start_by_shell(folder: &TestFolder, setup: &str) -> ChildGuard {
    let mut shell = Command::new("sh");
    shell.current_dir(folder.path()).args(["-c", &format!("{setup}; exec \"$0\" run --rig hosted --out run")]);
    ChildGuard(shell.arg(PROGRAM).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap())
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::abort("ABRT", 134)]
#[case::terminate("TERM", 143)]
#[case::computing_time("XCPU", 152)]
fn a_signal_sets_the_exit_code(#[case] name: &str, #[case] expected: i32) {
    let folder = long_folder();
    let bench = start_run(&folder);
    bench.signal(name);
    let counts = "played so far: 0 of 1 scenario: 0 passed, 0 failed, 0 inconclusive";
    bench.finish().assert_message(expected, &["the run was cancelled", counts]);
    assert!(!folder.record("run").complete);
}

/// As with `nohup cargo test-all`: the tests ignore SIGHUP, but not the programs that they start.
#[test]
fn tests_that_ignore_a_hang_up_can_test_it() {
    let names = ["signals::a_signal_sets_the_exit_code::case_1_hang_up", "live::a_closed_terminal_ends_the_run"];
    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' HUP; exec \"$0\" --exact \"$@\""]).arg(env::current_exe().unwrap()).args(names);
    let output = shell.output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.contains("2 passed"), "{text}");
}

#[test]
fn a_run_under_nohup_outlives_its_terminal() {
    let folder = long_folder();
    let bench = start_by_shell(&folder, "trap '' HUP");
    wait_for_traces(&folder);
    bench.signal("HUP");
    let before = complete_trace_count(&folder);
    wait_until("the run ended with its terminal", || complete_trace_count(&folder) >= before + 3);
    bench.signal("TERM");
    bench.finish().assert_exit(143);
}

#[test]
fn a_blocked_output_does_not_block_the_exit() {
    let folder = long_folder();
    let mut bench = bench_command(folder.path());
    bench.args(["run", "--rig", "hosted", "--format", "json", "--out", "run"]).env("PLATEBENCH_LOG", "trace");
    let mut bench = ChildGuard(bench.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    // 400 events of about 500 bytes are more than a pipe takes without a reader, 64 KiB.
    wait_until("too few complete trials", || complete_trace_count(&folder) >= 400);
    bench.signal("TERM");
    bench.wait_for_exit(&[143]);
    assert_eq!(folder.record("run").safe_confirmed, Some(true));
}

#[test]
fn a_file_size_limit_is_a_reported_error() {
    let folder = long_folder();
    start_by_shell(&folder, "ulimit -f 20").finish().assert_message(2, &["File too large"]);
}

/// Longer than 10 s, the watchdog timeout that the bench sets in a controller with its own clock.
const SUSPENSION: Duration = Duration::from_millis(11_500);

#[test]
fn a_suspended_bench_does_not_fail_the_controller() {
    let folder = TestFolder::with_minute();
    let log = folder.join("controller.log");
    let rig = controller_rig(Some(&log));
    let bench = start_bench(folder.path(), ["run", "--clock", "lockstep", "--out", "run", "--rig", &rig]);
    wait_until("the controller never ran", || fs::read_to_string(&log).unwrap_or_default().contains("\"running\""));
    bench.signal("STOP");
    sleep(SUSPENSION);
    bench.signal("CONT");
    // On a busy machine, a late answer or a lost controller may be the cause instead.
    bench.finish().assert_exit_in(&[3, 5]);
    let record = folder.record("run");
    let trial = &record.scenarios[0].trials[0];
    assert!(matches!(trial.cause, Some(Cause::Bench | Cause::Rig)), "{:?}", trial.reason);
}

#[test]
fn a_killed_run_can_still_be_judged_and_reported() {
    let folder = long_folder();
    start_run(&folder).kill();
    folder
        .bench(["report", "run", "--rejudge"])
        .assert_message(3, &["the run was interrupted; only its complete trials were judged"]);
    folder.bench(["report", "run"]).assert_exit(0);
    assert!(folder.read("run/report.html").contains("</html>"));
}
