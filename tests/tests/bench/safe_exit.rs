//! However the bench ends, the plate is at 0 V: seen from the other side, in what the controller wrote down.

use crate::test_folder::{
    TestFolder, bench_command, child_process_id, controller_rig, send_signal, step_scenario, wait_until,
};
use platebench_record::RunRecord;
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// Periods of 1 ms without a sample after which a controller is at 0 V, and as many again for a machine that is busy with something else.
const WATCHDOG_US: u64 = 5_000;
const BUSY_MACHINE_ALLOWANCE_US: u64 = 60_000;

/// A trial of a minute, so that its end is not what ends it.
fn start_run(workshop: &TestFolder, log: &Path) -> Child {
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 100.0");
    workshop.write_scenario("s.toml", &text.replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let mut bench = bench_command(workshop.path());
    let bench = bench.args(["run", "--clock", "real-time", "--out", "run", "--rig", &controller_rig(Some(log))]);
    bench.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn log_lines(log: &Path) -> Vec<Value> {
    let text = fs::read_to_string(log).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn wait_until_running(log: &Path) {
    let is_driven = |line: &Value| line["state"] == "running" && line["drive_vpp"].as_f64() > Some(0.0);
    wait_until("the controller never drove the plate", || log_lines(log).iter().any(is_driven));
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::quit("QUIT", 131)]
#[case::terminate("TERM", 143)]
fn a_signal_ends_with_a_confirmed_0_v(#[case] name: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    let log = workshop.path().join("controller.log");
    let bench = start_run(&workshop, &log);
    wait_until_running(&log);
    send_signal(&bench, name);
    let output = bench.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(expected), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = log_lines(&log);
    let stopped = lines.iter().position(|line| line["state"] == "safe").expect("the bench asked for 0 V");
    assert_eq!(lines[stopped]["drive_vpp"], 0.0);
    assert!(lines[stopped..].iter().all(|line| line["drive_vpp"] == 0.0), "{lines:#?}");
    assert_eq!(lines.last().unwrap()["event"], "end");
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!((record.safe_confirmed, record.complete), (Some(true), false));
}

#[test]
fn a_silent_controller_does_not_block_the_exit() {
    let workshop = TestFolder::new();
    let log = workshop.path().join("controller.log");
    let mut bench = start_run(&workshop, &log);
    wait_until_running(&log);
    // In one breath, so that the end is asked for before the controller counts as lost.
    let both = format!("kill -STOP {}; kill -INT {}", child_process_id(&bench), bench.id());
    assert!(Command::new("sh").args(["-c", &both]).status().unwrap().success());
    wait_until("the bench waits for an answer that never comes", || bench.try_wait().unwrap().is_some());
    let output = bench.wait_with_output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    // 5 where the machine was so busy that the silence was noticed first.
    assert!(matches!(output.status.code(), Some(130 | 5)), "{told}");
    assert!(told.contains("did not confirm 0 V"), "{told}");
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, Some(false));
}

#[test]
fn after_a_killed_bench_the_watchdog_acts() {
    let workshop = TestFolder::new();
    let log = workshop.path().join("controller.log");
    let mut bench = start_run(&workshop, &log);
    wait_until_running(&log);
    bench.kill().unwrap();
    bench.wait().unwrap();
    assert_eq!(RunRecord::read(&workshop.path().join("run")).unwrap().safe_confirmed, None, "nobody was left to know");
    wait_until("the controller never ended", || log_lines(&log).last().is_some_and(|line| line["event"] == "end"));
    let lines = log_lines(&log);
    let stopped = lines.iter().find(|line| line["state"] == "fault").expect("the watchdog acted");
    assert_eq!(stopped["cause"], "sample-timeout");
    assert_eq!(stopped["drive_vpp"], 0.0);
    let since = stopped["since_sample_us"].as_u64().unwrap();
    assert!((WATCHDOG_US..WATCHDOG_US + BUSY_MACHINE_ALLOWANCE_US).contains(&since), "0 V after {since} µs");
    assert!(lines.iter().all(|line| line["state"] != "safe"), "nobody was left to ask for it");
}
