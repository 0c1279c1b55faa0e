//! Checks in the controller's log that the plate is at 0 V after the bench ended in any way.

use crate::test_folder::{ChildGuard, SLOW_REAL_TIME, TestFolder, controller_rig, start_bench, wait_until};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The watchdog acts after five periods without a sample. A period of 1 ms takes 50 ms.
const WATCHDOG_US: u64 = 250_000;

fn running_bench(folder: &TestFolder) -> (ChildGuard, PathBuf) {
    let log = folder.join("controller.log");
    let rig = controller_rig(Some(&log));
    let bench = start_bench(folder.path(), ["run", "--out", "run", "--rig", &rig].iter().chain(&SLOW_REAL_TIME));
    let is_driven = |line: &Value| line["state"] == "running" && line["drive_vpp"].as_f64() > Some(0.0);
    wait_until("the controller never drove the plate", || log_lines(&log).iter().any(is_driven));
    (bench, log)
}

pub(crate) fn log_lines(log: &Path) -> Vec<Value> {
    let text = fs::read_to_string(log).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::terminate("TERM", 143)]
fn a_signal_ends_with_a_confirmed_0_v(#[case] name: &str, #[case] expected: i32) {
    let folder = TestFolder::with_minute();
    let (bench, log) = running_bench(&folder);
    bench.signal(name);
    bench.finish().assert_exit(expected);
    let lines = log_lines(&log);
    let stopped = lines.iter().position(|line| line["state"] == "safe").expect("the bench asked for 0 V");
    assert_eq!(lines[stopped]["drive_vpp"], 0.0);
    assert!(lines[stopped..].iter().all(|line| line["drive_vpp"] == 0.0), "{lines:#?}");
    assert_eq!(lines.last().unwrap()["event"], "end");
    let record = folder.record("run");
    assert_eq!((record.safe_confirmed, record.complete), (Some(true), false));
}

#[test]
fn a_silent_controller_does_not_block_the_exit() {
    let folder = TestFolder::with_minute();
    let (mut bench, _) = running_bench(&folder);
    // One command sends both signals, to request the end before the bench notices the silence.
    let both = format!("kill -STOP {}; kill -INT {}", bench.child_id(), bench.0.id());
    assert!(Command::new("sh").args(["-c", &both]).status().unwrap().success());
    wait_until("the bench waits for an answer that never comes", || bench.has_ended());
    // On a busy machine the bench may notice the silence before the signal; the code is then 5.
    bench.finish().assert_exit_in(&[130, 5]).assert_stderr(&["did not confirm 0 V"]);
    assert_eq!(folder.record("run").safe_confirmed, Some(false));
}

#[test]
fn after_a_killed_bench_the_watchdog_acts() {
    let folder = TestFolder::with_minute();
    let (mut bench, log) = running_bench(&folder);
    bench.kill();
    assert_eq!(folder.record("run").safe_confirmed, None);
    wait_until("the controller never ended", || log_lines(&log).last().is_some_and(|line| line["event"] == "end"));
    let lines = log_lines(&log);
    let stopped = lines.iter().find(|line| line["state"] == "fault").expect("the watchdog acted");
    assert_eq!(stopped["cause"], "sample-timeout");
    assert_eq!(stopped["drive_vpp"], 0.0);
    let since = stopped["since_sample_us"].as_u64().unwrap();
    assert!(since >= WATCHDOG_US, "0 V after {since} µs");
    assert!(lines.iter().all(|line| line["state"] != "safe"), "no request for 0 V");
}
