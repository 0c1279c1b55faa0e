//! Runs that are ended from outside.

use crate::bench::{Guarded, Workshop, await_that, call, code, controller, program, signal, step_scenario};
use platebench_verdict::{Cause, RunRecord};
use rstest::rstest;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

/// Far more trials than can be played while the test looks on.
fn endless() -> String {
    step_scenario("aluminium-198x138-noisy", "", "", "metric = \"settling_time_ms\"\nat_most = 100.0")
        .replace("duration_ms = 60.0", "duration_ms = 900.0")
        + "[trials]\ncount = 100000\n"
}

fn start(workshop: &Workshop) -> Child {
    workshop.scenario("s.toml", &endless());
    let mut command = program(workshop.path());
    command.args(["run", "--out", "run"]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// How many trials are whole.
fn traces(folder: &Path) -> usize {
    let entries = fs::read_dir(folder.join("run/traces/s")).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

/// Waits until some trials are whole.
fn await_traces(folder: &Path) {
    await_that("no trial became whole", || traces(folder) >= 3);
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::terminate("TERM", 143)]
fn a_polite_end_is_told_in_the_exit_code(#[case] name: &str, #[case] expected: i32) {
    let workshop = Workshop::new();
    let child = start(&workshop);
    await_traces(workshop.path());
    signal(&child, name);
    let output = child.wait_with_output().unwrap();
    assert_eq!(code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stderr).contains("ended early"));
    assert!(!RunRecord::read(&workshop.path().join("run")).unwrap().complete);
}

#[test]
fn a_run_under_nohup_outlives_its_terminal() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &endless());
    let bench = program(workshop.path());
    let mut shell = Command::new("sh");
    shell.current_dir(workshop.path()).args(["-c", "trap '' HUP; exec \"$0\" run --rig hosted --out run"]);
    let shell = shell.arg(bench.get_program()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    await_traces(workshop.path());
    signal(&shell, "HUP");
    let then = traces(workshop.path());
    await_that("it went with its terminal", || traces(workshop.path()) >= then + 3);
    signal(&shell, "TERM");
    assert_eq!(code(&shell.wait_with_output().unwrap()), 143);
}

#[test]
fn a_reader_that_takes_nothing_keeps_nobody_from_ending() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &endless());
    let mut bench = program(workshop.path());
    bench.args(["run", "--rig", "hosted", "--format", "json", "--out", "run"]).env("PLATEBENCH_LOG", "trace");
    let mut bench = Guarded(bench.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    // A trial is told in some 500 bytes, and a pipe takes 64 KiB.
    await_that("too few trials became whole", || traces(workshop.path()) >= 400);
    signal(&bench.0, "TERM");
    await_that("it waits for a reader", || bench.0.try_wait().unwrap().is_some());
    assert_eq!(bench.0.wait().unwrap().code(), Some(143));
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, Some(true));
}

#[test]
fn a_limit_on_file_sizes_is_an_error_and_not_a_death() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &endless());
    let mut shell = Command::new("sh");
    shell.current_dir(workshop.path()).args(["-c", "ulimit -f 20; exec \"$0\" run --rig hosted --out run"]);
    let output = shell.arg(program(workshop.path()).get_program()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{told}");
    assert!(told.contains("File too large"), "{told}");
}

/// Longer than a controller with a clock of its own has patience.
const AWAY: Duration = Duration::from_millis(1_500);

#[test]
fn a_bench_that_was_stopped_for_a_while_is_not_the_controller_s_failure() {
    let workshop = Workshop::new();
    let log = workshop.path().join("controller.log");
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 100.0");
    workshop.scenario("s.toml", &text.replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let mut bench = program(workshop.path());
    bench.args(["run", "--clock", "lockstep", "--out", "run", "--rig", &controller(Some(&log))]);
    let bench = bench.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    await_that("the controller never ran", || fs::read_to_string(&log).unwrap_or_default().contains("\"running\""));
    signal(&bench, "STOP");
    sleep(AWAY);
    signal(&bench, "CONT");
    let output = bench.wait_with_output().unwrap();
    // A machine so busy that an answer came too late besides leaves it undecided because of that, or takes the controller for lost.
    assert!(matches!(code(&output), 3 | 5), "{}", String::from_utf8_lossy(&output.stderr));
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    let trial = &record.scenarios[0].trials[0];
    assert!(matches!(trial.cause, Some(Cause::Bench | Cause::Rig)), "{:?}", trial.reason);
}

#[test]
fn a_killed_run_can_still_be_judged_and_reported() {
    let workshop = Workshop::new();
    let mut child = start(&workshop);
    await_traces(workshop.path());
    child.kill().unwrap();
    child.wait().unwrap();
    let output = call(workshop.path(), ["judge", "run"]);
    assert_eq!(code(&output), 3, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stderr).contains("cut off"));
    assert_eq!(code(&call(workshop.path(), ["report", "run"])), 0);
    assert!(fs::read_to_string(workshop.path().join("run/report.html")).unwrap().contains("</html>"));
}
