//! Controllers with a clock of their own: a program on a pseudo-terminal, in lockstep and in real time.
//!
//! The machine may be busy: nothing here depends on how punctual anybody was, only on what is said about it.

use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, child_process_id, controller_rig, exit_code, run_bench, send_signal,
    step_scenario, wait_until, workspace_root,
};
use platebench_record::TimingRecord;
use platebench_record::{RunRecord, Verdict};
use platebench_trace::Flags;
use rstest::rstest;
use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

const EXPECT: &str =
    "metric = \"settling_time_ms\"\nat_most = 2.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 0.1";

/// Every trace of a run by its path.
pub(crate) fn read_traces(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.join("traces")];
    while let Some(below) = open.pop() {
        for entry in fs::read_dir(below).unwrap().map(|entry| entry.unwrap().path()) {
            if entry.is_dir() {
                open.push(entry);
            } else {
                found.insert(entry.strip_prefix(folder).unwrap().to_owned(), fs::read(&entry).unwrap());
            }
        }
    }
    found
}

#[test]
fn a_program_in_lockstep_gives_the_hosted_traces() {
    let folder = tempfile::tempdir().unwrap();
    let paper = workspace_root().join("scenarios/paper");
    for (rig, out) in [("hosted", "hosted"), (&*controller_rig(None), "program")] {
        let output = run_bench(folder.path(), ["run", paper.to_str().unwrap(), "--rig", rig, "--out", out]);
        assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
    }
    let [hosted, program] = ["hosted", "program"].map(|out| read_traces(&folder.path().join(out)));
    assert!(hosted.len() > 20, "{} traces", hosted.len());
    assert!(hosted.keys().eq(program.keys()));
    for (path, bytes) in &hosted {
        assert!(program[path] == *bytes, "{} differs", path.display());
    }
}

/// Plays the paper's step in real time and returns its record.
fn run_real_time(workshop: &TestFolder, arguments: &[&str]) -> RunRecord {
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", EXPECT));
    let output = run_bench(workshop.path(), ["run", "--clock", "real-time", "--out", "run"].iter().chain(arguments));
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    // A busy machine leaves it undecided, and no machine makes a controller fail that passes.
    assert_ne!(record.verdict, Verdict::Fail, "{}", String::from_utf8_lossy(&output.stdout));
    assert_eq!(exit_code(&output), if record.verdict == Verdict::Pass { 0 } else { 3 });
    assert_eq!(record.clock, platebench_record::ClockKind::RealTime);
    record
}

fn timing(record: &RunRecord) -> &TimingRecord {
    record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap()
}

#[rstest]
#[case::hosted("hosted".to_owned())]
#[case::program(controller_rig(None))]
fn real_time_timing_counts_add_up(#[case] rig: String) {
    let workshop = TestFolder::new();
    let record = run_real_time(&workshop, &["--rig", &rig]);
    let timing = timing(&record);
    assert_eq!((timing.pacing.as_str(), timing.time_scale, timing.periods), ("bench", 1.0, 60));
    assert!(timing.safe_confirmed && timing.lost_rows == 0 && timing.refused_frames == 0);
    // The last one may wait at the end.
    assert!(timing.lost_replies <= timing.missed_replies + 1);
    let delay = timing.loop_delay_us.unwrap();
    assert!(0.0 < delay.p50 && delay.p50 <= delay.p99 && delay.p99 <= delay.max, "{delay:?}");
    let budget = timing.loop_delay_budget_us.unwrap();
    assert!((1_300.0..1_400.0).contains(&budget), "{budget}");

    let trial = &record.scenarios[0].trials[0];
    let rows = platebench_trace::read_trace(&workshop.path().join("run").join(&trial.trace)).unwrap();
    let flagged = |flag| rows.iter().filter(move |row| row.flags.contains(flag));
    assert_eq!(flagged(Flags::CONTROL).count() as u64, timing.periods - timing.skipped);
    assert_eq!(flagged(Flags::OVERRUN).count() as u64, timing.overruns);
    assert_eq!(flagged(Flags::LINK_LOST).count() as u64, timing.missed_replies);
    for row in flagged(Flags::CONTROL) {
        assert_eq!(
            row.t_s,
            (row.t_s * 1e3).round() / 1e3,
            "the plate is sampled at the deadline, however late the bench is"
        );
        assert!(row.lateness_us >= 0.0);
    }
    let latest = rows.iter().map(|row| row.lateness_us).fold(0.0, f64::max);
    assert!((latest / timing.lateness_us.max - 1.0).abs() < 0.01, "{latest} {}", timing.lateness_us.max);
    // The first command acts when it was there, not at the control instant that it belongs to.
    let driven = rows.iter().find(|row| row.drive_vpp > 0.0).unwrap();
    assert!(driven.t_s > 0.0 && !driven.flags.contains(Flags::CONTROL), "{driven:?}");

    let again = run_bench(workshop.path(), ["judge", "run", "--format", "json"]);
    let again: RunRecord = serde_json::from_slice(&again.stdout).unwrap();
    let verdicts = |record: &RunRecord| -> Vec<_> {
        record.scenarios[0].expectations.iter().map(|expectation| (expectation.verdict, expectation.cause)).collect()
    };
    assert_eq!(verdicts(&again), verdicts(&record));
}

#[test]
fn a_slower_plate_makes_the_same_line_faster() {
    let workshop = TestFolder::new();
    let record = run_real_time(&workshop, &["--rig", &controller_rig(None), "--time-scale", "0.1"]);
    let timing = timing(&record);
    assert_eq!((timing.time_scale, timing.periods), (0.1, 60));
    let telemetry = &record.scenarios[0].trials[0].telemetry;
    let (acting, on_the_wall) = (telemetry.loop_delay_us.unwrap(), telemetry.rig_delay_us.unwrap());
    assert!((acting / on_the_wall - 0.1).abs() < 0.001, "{acting} of {on_the_wall}");
    assert!(record.scenarios[0].trials[0].wall_ms.unwrap() >= 600.0);
}

#[test]
fn a_controller_s_own_timer_makes_the_control_instants() {
    let workshop = TestFolder::new();
    let record = run_real_time(&workshop, &["--rig", &controller_rig(None), "--pacing", "target"]);
    let timing = timing(&record);
    assert_eq!(timing.pacing, "target");
    // How many fit, a busy machine decides: the target skips what it is too late for, and stops where it hears nothing.
    assert!(timing.periods > 0);
    let trial = &record.scenarios[0].trials[0];
    let rows = platebench_trace::read_trace(&workshop.path().join("run").join(&trial.trace)).unwrap();
    let instants: Vec<f64> = rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).map(|row| row.t_s).collect();
    assert_eq!(instants[0], 0.0, "the first tick is the start");
    assert!(instants[1..].iter().any(|t_s| *t_s != (t_s * 1e3).round() / 1e3), "none of the bench's own deadlines");
}

#[test]
fn a_terminated_program_is_a_lost_rig() {
    let workshop = TestFolder::new();
    let text =
        step_scenario("aluminium-198x138", "", "", EXPECT).replace("duration_ms = 60.0", "duration_ms = 60000.0");
    workshop.write_scenario("s.toml", &text);
    let log = workshop.path().join("controller.log");
    let mut bench = bench_command(workshop.path());
    let bench = bench.args(["run", "--clock", "real-time", "--out", "run", "--rig", &controller_rig(Some(&log))]);
    let bench = bench.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait_until("the controller never ran", || fs::read_to_string(&log).is_ok_and(|text| text.contains("running")));
    assert!(Command::new("kill").args(["-KILL", &child_process_id(&bench)]).status().unwrap().success());
    let output = bench.wait_with_output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 5, "{error}");
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!(record.verdict, Verdict::Inconclusive, "{error}");
    let ended = record.scenarios[0].trials[0].telemetry.ended.as_ref().unwrap();
    assert!(ended.contains("signal 9"), "{ended}");
    assert!(!record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap().safe_confirmed);
    assert_eq!(record.safe_confirmed, Some(false));
}

#[rstest]
#[case::too_slow(&["--rig", "serial:/dev/no-such-port@115200"], "500000 baud is enough")]
#[case::scale_in_lockstep(&["--rig", "hosted", "--time-scale", "0.5"], "--clock real-time")]
#[case::wire_time_in_real_time(&["--rig", "emulated", "--clock", "real-time", "--wire-time"], "--clock lockstep")]
#[case::scaled_target(&["--rig", "hosted", "--clock", "real-time", "--pacing", "target", "--time-scale", "0.5"], "--pacing bench")]
#[case::no_place(&["--rig", "exec:true"], "{port}")]
#[case::no_program(&["--rig", "exec:no-such-program {port}"], "no-such-program")]
fn contradictory_options_are_rejected_before_the_run(#[case] arguments: &[&str], #[case] told: &str) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", EXPECT));
    let output = run_bench(workshop.path(), ["run", "--out", "run"].iter().chain(arguments));
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{error}");
    assert!(error.contains(told), "{error}");
}

#[rstest]
#[case::no_port("serial:/dev/no-such-port", "/dev/no-such-port")]
#[case::silent("exec:sh -c 'exec sleep 60' {port}", "did not answer the handshake")]
#[case::ends("exec:false {port}", "exit status 1")]
fn an_absent_rig_is_reported(#[case] rig: &str, #[case] told: &str) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", EXPECT));
    let output = run_bench(workshop.path(), ["run", "--rig", rig, "--out", "run"]);
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 5, "{error}");
    assert!(error.contains(told), "{error}");
}

#[test]
fn emulate_serves_several_controllers_in_turn() {
    let workshop = TestFolder::new();
    // A controller stops after five periods without a sample: 100 ms, which a busy machine keeps, and not 5 ms.
    let slow = "period_ms = 20.0\nresponse_time_ms = 100.0";
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", slow, "", EXPECT));
    let mut plate = bench_command(workshop.path());
    let plate = plate.args(["emulate", "--port", "pty", "--scenario", "scenarios/s.toml"]).stdin(Stdio::null());
    let mut plate = ChildGuard(plate.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap());
    let stdout = BufReader::new(plate.0.stdout.take().unwrap());
    let (sender, lines) = mpsc::channel();
    // Every wait has an end.
    std::thread::spawn(move || stdout.lines().map(Result::unwrap).try_for_each(|line| sender.send(line)));
    let next = || lines.recv_timeout(Duration::from_mins(1)).expect("a line each second");
    let port = next().strip_prefix("port: ").expect("the first line names the port").to_owned();
    for number in 0..2 {
        let log = workshop.path().join(format!("{number}.log"));
        let mut controller = Command::new(env!("CARGO_BIN_EXE_controller-under-test"));
        let controller = ChildGuard(controller.args([&port, "--log", log.to_str().unwrap()]).spawn().unwrap());
        let held = (0..30).map(|_| next()).find(|line| line.contains("|W| 2.000 of 2.000 µm")).expect("it settles");
        assert!(held.contains("287 Vpp"), "{held}");
        drop(controller);
    }
    send_signal(&plate.0, "TERM");
    assert_eq!(plate.0.wait().unwrap().code(), Some(143));
}
