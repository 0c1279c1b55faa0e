//! Tests controllers that are programs on a pseudo-terminal, in lockstep and in real time.
//!
//! The tests allow late samples, because the machine may be busy with other work. Programs run so slowly
//! that a stall of 0.1 s stops none of them.

use crate::test_folder::{
    ChildGuard, SLOW_REAL_TIME, TestFolder, assert_same_traces, bench_command, controller_rig, run_bench, start_bench,
    step_scenario, wait_until, workspace_root,
};
use platebench_model::record::{ClockKind, RunRecord, TimingRecord, TrialRecord, Verdict};
use platebench_model::trace::Flags;
use rstest::rstest;
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

const EXPECT: &str =
    "metric = \"settling_time_ms\"\nat_most = 2.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 0.1";

#[test]
fn a_program_in_lockstep_gives_the_hosted_traces() {
    let folder = tempfile::tempdir().unwrap();
    let paper = workspace_root().join("scenarios/paper");
    for (rig, out) in [("hosted", "hosted"), (&*controller_rig(None), "program")] {
        // On a busy machine, a reply may take longer than the default 500 ms.
        let run = ["run", paper.to_str().unwrap(), "--rig", rig, "--reply-timeout", "5000", "--out", out];
        run_bench(folder.path(), run).assert_exit(0);
    }
    assert_same_traces(folder.path(), ["hosted", "program"]);
}

fn run_real_time(folder: &TestFolder, arguments: &[&str]) -> RunRecord {
    let output = folder.bench(["run", "--clock", "real-time", "--out", "run"].iter().chain(arguments));
    let record = folder.record("run");
    // A late bench may make the verdict inconclusive, but never a failure.
    assert_ne!(record.verdict, Verdict::Fail, "{}", output.stdout);
    output.assert_exit(if record.verdict == Verdict::Pass { 0 } else { 3 });
    assert_eq!(record.clock, ClockKind::RealTime);
    record
}

fn trial(record: &RunRecord) -> &TrialRecord {
    &record.scenarios[0].trials[0]
}

fn timing(record: &RunRecord) -> &TimingRecord {
    trial(record).telemetry.timing.as_ref().unwrap()
}

#[rstest]
#[case::hosted("hosted".to_owned(), 1.0)]
#[case::program(controller_rig(None), 0.02)]
fn real_time_timing_counts_add_up(#[case] rig: String, #[case] time_scale: f64) {
    let folder = TestFolder::with_step(EXPECT);
    let record = run_real_time(&folder, &["--rig", &rig, "--time-scale", &time_scale.to_string()]);
    let timing = timing(&record);
    assert_eq!((timing.pacing.as_str(), timing.time_scale, timing.periods), ("bench", time_scale, 60));
    assert!(trial(&record).wall_ms.unwrap() >= 60.0 / time_scale);
    let telemetry = &trial(&record).telemetry;
    let (plate_us, wall_us) = (telemetry.loop_delay_us.unwrap(), telemetry.rig_delay_us.unwrap());
    assert!((plate_us / wall_us / time_scale - 1.0).abs() < 0.01, "{plate_us} of {wall_us}");
    assert!(timing.safe_confirmed && timing.lost_rows == 0 && timing.rejected_frames == 0);
    // The reply to the last sample may still be missing when the trial ends.
    assert!(timing.lost_replies <= timing.missed_replies + 1);
    let delay = timing.loop_delay_us.unwrap();
    assert!(0.0 < delay.p50 && delay.p50 <= delay.p99 && delay.p99 <= delay.max, "{delay:?}");
    let budget = timing.loop_delay_budget_us.unwrap();
    assert!((1_300.0..1_400.0).contains(&budget), "{budget}");

    let rows = folder.rows("run", trial(&record));
    let flagged = |flag| rows.iter().filter(move |row| row.flags.contains(flag));
    assert_eq!(flagged(Flags::CONTROL).count() as u64, timing.periods - timing.skipped);
    assert_eq!(flagged(Flags::OVERRUN).count() as u64, timing.overruns);
    assert_eq!(flagged(Flags::LINK_LOST).count() as u64, timing.missed_replies);
    for row in flagged(Flags::CONTROL) {
        assert_eq!(row.t_s, (row.t_s * 1e3).round() / 1e3, "the plate is sampled at the deadline");
        assert!(row.lateness_us >= 0.0);
    }
    let latest = rows.iter().map(|row| row.lateness_us).fold(0.0, f64::max);
    assert!((latest / timing.lateness_us.max - 1.0).abs() < 0.01, "{latest} {}", timing.lateness_us.max);
    // In real time, the first command acts when it arrives, not at its control instant.
    let driven = rows.iter().find(|row| row.drive_vpp > 0.0).unwrap();
    assert!(driven.t_s > 0.0 && !driven.flags.contains(Flags::CONTROL), "{driven:?}");

    let again: RunRecord =
        serde_json::from_value(folder.bench(["report", "run", "--rejudge", "--format", "json"]).json()).unwrap();
    let verdicts = |record: &RunRecord| {
        record.scenarios[0].expectations.iter().map(|it| (it.verdict, it.cause)).collect::<Vec<_>>()
    };
    assert_eq!(verdicts(&again), verdicts(&record));
}

#[test]
fn the_target_s_timer_sets_the_control_instants() {
    // The watchdog waits five periods, 250 ms.
    let slow = "period_ms = 50.0\nresponse_time_ms = 250.0";
    let expect = "metric = \"overshoot_percent\"\nat_most = 100.0";
    let text = step_scenario("aluminium-198x138", slow, "", expect);
    let folder = TestFolder::with_scenario(&text.replace("duration_ms = 60.0", "duration_ms = 1000.0"));
    let record = run_real_time(&folder, &["--rig", &controller_rig(None), "--pacing", "target"]);
    let timing = timing(&record);
    // On a busy machine, the target skips periods, so their exact number is not checked.
    assert_eq!((timing.pacing.as_str(), trial(&record).telemetry.stopped.as_deref()), ("target", None));
    // If the target's clock is fast, the tick at the end is one more.
    assert!((2..=21).contains(&timing.periods), "{timing:?}");
    let rows = folder.rows("run", trial(&record));
    let instants: Vec<f64> = rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).map(|row| row.t_s).collect();
    assert_eq!(instants[0], 0.0, "the first tick is the start");
    assert!(instants[1..].iter().any(|t_s| *t_s != (t_s * 1e3).round() / 1e3), "not the deadlines of the bench");
}

#[test]
fn a_terminated_program_fails_its_trial() {
    let folder = TestFolder::with_minute();
    let log = folder.join("controller.log");
    let rig = controller_rig(Some(&log));
    let bench = start_bench(folder.path(), ["run", "--out", "run", "--rig", &rig].iter().chain(&SLOW_REAL_TIME));
    wait_until("the controller never ran", || fs::read_to_string(&log).is_ok_and(|text| text.contains("running")));
    assert!(Command::new("kill").args(["-KILL", &bench.child_id()]).status().unwrap().success());
    bench.finish().assert_exit_in(&[1, 5]);
    let record = folder.record("run");
    let ended = trial(&record).telemetry.ended.as_ref().unwrap();
    assert!(ended.contains("signal 9"), "{ended}");
    // On a busy machine, the bench or the answers may be too late for a verdict.
    if record.verdict == Verdict::Inconclusive {
        assert!(trial(&record).cause.is_some());
        return;
    }
    assert_eq!((record.verdict, record.safe_confirmed), (Verdict::Fail, Some(false)));
    assert!(!timing(&record).safe_confirmed);
}

#[test]
fn plate_serve_serves_several_controllers_in_turn() {
    // The watchdog waits five periods. With 20 ms these are 100 ms, enough for a busy machine.
    let slow = "period_ms = 20.0\nresponse_time_ms = 100.0";
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", slow, "", EXPECT));
    let mut plate = bench_command(folder.path());
    let plate = plate.args(["plate", "serve", "--port", "pty", "--scenario", "scenarios/s.toml"]).stdin(Stdio::null());
    let mut plate = ChildGuard(plate.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap());
    let stdout = BufReader::new(plate.0.stdout.take().unwrap());
    let (sender, lines) = mpsc::channel();
    std::thread::spawn(move || stdout.lines().map(Result::unwrap).try_for_each(|line| sender.send(line)));
    let next = || lines.recv_timeout(Duration::from_mins(1)).expect("a line each second");
    let port = next().strip_prefix("port: ").expect("the first line names the port").to_owned();
    for number in 0..2 {
        let log = folder.join(&format!("{number}.log"));
        let mut controller = Command::new(env!("CARGO_BIN_EXE_controller-under-test"));
        let controller = ChildGuard(controller.args([&port, "--log", log.to_str().unwrap()]).spawn().unwrap());
        let settled = (0..30).map(|_| next()).find(|line| line.contains("|W| 2.000 of 2.000 µm")).expect("it settles");
        assert!(settled.contains("287 Vpp"), "{settled}");
        drop(controller);
    }
    plate.signal("TERM");
    plate.wait_for_exit(&[143]);
}
