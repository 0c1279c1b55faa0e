//! Runs that are ended from outside.

use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, controller_rig, exit_code, run_bench, send_signal, step_scenario, wait_until,
};
use platebench_record::{Cause, RunRecord};
use rstest::rstest;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

/// Far more trials than can be played while the test looks on.
fn long_scenario() -> String {
    step_scenario("aluminium-198x138-noisy", "", "", "metric = \"settling_time_ms\"\nat_most = 100.0")
        .replace("duration_ms = 60.0", "duration_ms = 900.0")
        + "[trials]\ncount = 100000\n"
}

fn start_run(workshop: &TestFolder) -> Child {
    workshop.write_scenario("s.toml", &long_scenario());
    let mut command = bench_command(workshop.path());
    command.args(["run", "--out", "run"]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// How many trials are whole.
fn complete_trace_count(folder: &Path) -> usize {
    let entries = fs::read_dir(folder.join("run/traces/s")).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

/// Waits until some trials are whole.
fn wait_for_traces(folder: &Path) {
    wait_until("no trial became whole", || complete_trace_count(folder) >= 3);
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::abort("ABRT", 134)]
#[case::terminate("TERM", 143)]
#[case::computing_time("XCPU", 152)]
fn a_signal_sets_the_exit_code(#[case] name: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    let child = start_run(&workshop);
    wait_for_traces(workshop.path());
    send_signal(&child, name);
    let output = child.wait_with_output().unwrap();
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stderr).contains("the run was cancelled"));
    assert!(!RunRecord::read(&workshop.path().join("run")).unwrap().complete);
}

#[test]
fn a_run_under_nohup_outlives_its_terminal() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &long_scenario());
    let bench = bench_command(workshop.path());
    let mut shell = Command::new("sh");
    shell.current_dir(workshop.path()).args(["-c", "trap '' HUP; exec \"$0\" run --rig hosted --out run"]);
    let shell = shell.arg(bench.get_program()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait_for_traces(workshop.path());
    send_signal(&shell, "HUP");
    let then = complete_trace_count(workshop.path());
    wait_until("it went with its terminal", || complete_trace_count(workshop.path()) >= then + 3);
    send_signal(&shell, "TERM");
    assert_eq!(exit_code(&shell.wait_with_output().unwrap()), 143);
}

#[test]
fn a_blocked_output_does_not_block_the_exit() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &long_scenario());
    let mut bench = bench_command(workshop.path());
    bench.args(["run", "--rig", "hosted", "--format", "json", "--out", "run"]).env("PLATEBENCH_LOG", "trace");
    let mut bench = ChildGuard(bench.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    // A trial is told in some 500 bytes, and a pipe takes 64 KiB.
    wait_until("too few trials became whole", || complete_trace_count(workshop.path()) >= 400);
    send_signal(&bench.0, "TERM");
    wait_until("it waits for a reader", || bench.0.try_wait().unwrap().is_some());
    assert_eq!(bench.0.wait().unwrap().code(), Some(143));
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, Some(true));
}

#[test]
fn a_file_size_limit_is_a_reported_error() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &long_scenario());
    let mut shell = Command::new("sh");
    shell.current_dir(workshop.path()).args(["-c", "ulimit -f 20; exec \"$0\" run --rig hosted --out run"]);
    let output = shell.arg(bench_command(workshop.path()).get_program()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("File too large"), "{told}");
}

/// Longer than the watchdog timeout of 10 s that the bench states to a controller with its own clock.
const SUSPENSION: Duration = Duration::from_millis(11_500);

#[test]
fn a_suspended_bench_does_not_fail_the_controller() {
    let workshop = TestFolder::new();
    let log = workshop.path().join("controller.log");
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 100.0");
    workshop.write_scenario("s.toml", &text.replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let mut bench = bench_command(workshop.path());
    bench.args(["run", "--clock", "lockstep", "--out", "run", "--rig", &controller_rig(Some(&log))]);
    let bench = bench.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait_until("the controller never ran", || fs::read_to_string(&log).unwrap_or_default().contains("\"running\""));
    send_signal(&bench, "STOP");
    sleep(SUSPENSION);
    send_signal(&bench, "CONT");
    let output = bench.wait_with_output().unwrap();
    // A machine so busy that an answer came too late besides leaves it undecided because of that, or takes the controller for lost.
    assert!(matches!(exit_code(&output), 3 | 5), "{}", String::from_utf8_lossy(&output.stderr));
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    let trial = &record.scenarios[0].trials[0];
    assert!(matches!(trial.cause, Some(Cause::Bench | Cause::Rig)), "{:?}", trial.reason);
}

#[test]
fn a_killed_run_can_still_be_judged_and_reported() {
    let workshop = TestFolder::new();
    let mut child = start_run(&workshop);
    wait_for_traces(workshop.path());
    child.kill().unwrap();
    child.wait().unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    assert_eq!(exit_code(&output), 3, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("the run was interrupted; judged are its complete trials")
    );
    assert_eq!(exit_code(&run_bench(workshop.path(), ["report", "run"])), 0);
    assert!(fs::read_to_string(workshop.path().join("run/report.html")).unwrap().contains("</html>"));
}
