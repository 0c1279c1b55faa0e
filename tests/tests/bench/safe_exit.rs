//! However the bench ends, the plate is at 0 V: seen from the other side, in what the controller wrote down.

use crate::bench::{Workshop, await_that, child_of, controller, program, signal, step_scenario};
use platebench_verdict::RunRecord;
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// Periods of 1 ms without a sample after which a controller is at 0 V, and as many again for a machine that is busy with something else.
const WATCHDOG_US: u64 = 5_000;
const BUSY_US: u64 = 60_000;

/// A trial of a minute, so that its end is not what ends it.
fn start(workshop: &Workshop, log: &Path) -> Child {
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 100.0");
    workshop.scenario("s.toml", &text.replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let mut bench = program(workshop.path());
    let bench = bench.args(["run", "--clock", "real-time", "--out", "run", "--rig", &controller(Some(log))]);
    bench.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn lines(log: &Path) -> Vec<Value> {
    let text = fs::read_to_string(log).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn await_running(log: &Path) {
    let is_driven = |line: &Value| line["state"] == "running" && line["drive_vpp"].as_f64() > Some(0.0);
    await_that("the controller never drove the plate", || lines(log).iter().any(is_driven));
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::terminate("TERM", 143)]
fn a_polite_end_is_confirmed_by_the_controller(#[case] name: &str, #[case] expected: i32) {
    let workshop = Workshop::new();
    let log = workshop.path().join("controller.log");
    let bench = start(&workshop, &log);
    await_running(&log);
    signal(&bench, name);
    let output = bench.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(expected), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = lines(&log);
    let stopped = lines.iter().position(|line| line["state"] == "safe").expect("the bench asked for 0 V");
    assert_eq!(lines[stopped]["drive_vpp"], 0.0);
    assert!(lines[stopped..].iter().all(|line| line["drive_vpp"] == 0.0), "{lines:#?}");
    assert_eq!(lines.last().unwrap()["event"], "end");
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!((record.safe_confirmed, record.complete), (Some(true), false));
}

#[test]
fn a_controller_that_answers_no_more_holds_nobody_up_and_is_told_of() {
    let workshop = Workshop::new();
    let log = workshop.path().join("controller.log");
    let mut bench = start(&workshop, &log);
    await_running(&log);
    // In one breath, so that the end is asked for before the controller counts as lost.
    let both = format!("kill -STOP {}; kill -INT {}", child_of(&bench), bench.id());
    assert!(Command::new("sh").args(["-c", &both]).status().unwrap().success());
    await_that("the bench waits for an answer that never comes", || bench.try_wait().unwrap().is_some());
    let output = bench.wait_with_output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    // 5 where the machine was so busy that the silence was noticed first.
    assert!(matches!(output.status.code(), Some(130 | 5)), "{told}");
    assert!(told.contains("did not confirm 0 V"), "{told}");
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, Some(false));
}

#[test]
fn a_bench_that_is_killed_leaves_the_controller_s_own_watchdog() {
    let workshop = Workshop::new();
    let log = workshop.path().join("controller.log");
    let mut bench = start(&workshop, &log);
    await_running(&log);
    bench.kill().unwrap();
    bench.wait().unwrap();
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, None, "nobody was left to know");
    await_that("the controller never ended", || lines(&log).last().is_some_and(|line| line["event"] == "end"));
    let lines = lines(&log);
    let stopped = lines.iter().find(|line| line["state"] == "fault").expect("the watchdog acted");
    assert_eq!(stopped["cause"], "sample-timeout");
    assert_eq!(stopped["drive_vpp"], 0.0);
    let since = stopped["since_sample_us"].as_u64().unwrap();
    assert!((WATCHDOG_US..WATCHDOG_US + BUSY_US).contains(&since), "0 V after {since} µs");
    assert!(lines.iter().all(|line| line["state"] != "safe"), "nobody was left to ask for it");
}
