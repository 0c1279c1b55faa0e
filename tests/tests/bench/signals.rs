//! Runs that are ended from outside.

use crate::bench::{Workshop, await_that, call, code, program, signal, step_scenario};
use platebench_verdict::RunRecord;
use rstest::rstest;
use std::fs;
use std::path::Path;
use std::process::{Child, Stdio};

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

/// Waits until some trials are whole.
fn await_traces(folder: &Path) {
    let whole = || {
        let entries = fs::read_dir(folder.join("run/traces/s")).into_iter().flatten().flatten();
        entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
    };
    await_that("no trial became whole", || whole() >= 3);
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
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
