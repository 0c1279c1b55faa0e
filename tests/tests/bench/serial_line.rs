//! Tests lines in real time: planned faults, a port that two benches open, and TCP.
//!
//! Results that depend on the load of the machine are checked only in runs without overruns.

use crate::test_folder::{
    SETTLING, TestFolder, controller_rig, lock_heavy_load, run_bench, start_bench, wait_until, workspace_root,
};
use platebench_model::record::{ClockKind, RunRecord, Telemetry, Verdict};
use platebench_model::trace::{Flags, Row, read_trace};
use platebench_rig::{HostedLink, Link, PtyLink};
use platebench_test_kit::serve_board;
use rstest::rstest;
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const STOPPED: Option<&str> = Some("no sample within the watchdog timeout");

/// Runs a fault scenario at time scale 0.1. `None` if a lack of processor time ended it.
fn run_with_line_fault(name: &str, out: &str) -> Option<(RunRecord, Vec<Row>)> {
    let folder = tempfile::tempdir().unwrap();
    let scenario = workspace_root().join(format!("scenarios/faults/{name}.toml"));
    let rig = controller_rig(None);
    let arguments = ["--clock", "real-time", "--time-scale", "0.1", "--rig", &rig, "--out", out];
    let output = run_bench(folder.path(), ["run", scenario.to_str().unwrap()].iter().chain(&arguments));
    let record = RunRecord::read(&folder.path().join(out)).unwrap();
    assert_ne!(record.verdict, Verdict::Fail, "{}", output.stdout);
    if record.has_lost_controller() || record.safe_confirmed == Some(false) {
        output.assert_exit(5);
        return None;
    }
    output.assert_exit(if record.verdict == Verdict::Pass { 0 } else { 3 });
    assert_eq!(record.safe_confirmed, Some(true));
    let rows = read_trace(&folder.path().join(out).join(&record.scenarios[0].trials[0].trace)).unwrap();
    Some((record, rows))
}

fn telemetry(record: &RunRecord) -> &Telemetry {
    &record.scenarios[0].trials[0].telemetry
}

#[rstest]
#[case::a_sample("lost-sample", "drop", 1, None, true)]
#[case::five_samples("five-periods-of-silence", "drop", 5, STOPPED, false)]
#[case::the_line("disconnect-and-reconnect", "disconnect", 31, STOPPED, true)]
fn wire_faults_act_on_a_live_line(
    #[case] name: &str,
    #[case] kind: &str,
    #[case] count: u64,
    #[case] reason: Option<&str>,
    #[case] runs_at_the_end: bool,
) {
    let _guard = lock_heavy_load();
    // Number of attempts in which the controller lacked processor time for 0.25 s.
    let mut starved = 0;
    for attempt in 0..5 {
        let Some((record, rows)) = run_with_line_fault(name, &attempt.to_string()) else {
            starved += 1;
            continue;
        };
        let telemetry = telemetry(&record);
        let timing = telemetry.timing.as_ref().unwrap();
        let applied: Vec<_> = telemetry.faults.keys().map(String::as_str).collect();
        assert!(applied.is_empty() || applied == [kind], "{applied:?}");
        assert_eq!((telemetry.ended.as_deref(), timing.rejected_frames), (None, 0), "no other fault of the line");
        let was_at_rest = rows.iter().any(|row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0);
        assert_eq!(was_at_rest, telemetry.stopped.is_some());
        // An overrun may move a sample into the window of the fault or out of it.
        if timing.overruns == 0 {
            // A controller without processor time answers earlier samples while the line is dead.
            if timing.missed_replies > count {
                starved += 1;
                continue;
            }
            // A disconnection also drops the controller's stop message, which is no reply. A
            // controller without processor time sends it only after the disconnection.
            let samples = if kind == "disconnect" { count - 1 } else { count };
            assert!((samples..=count).contains(&telemetry.faults[kind]), "{telemetry:?}");
            // The reply to the last sample may still be missing when the trial ends.
            assert!((samples..=timing.missed_replies + 1).contains(&timing.lost_replies), "{timing:?}");
            assert!(telemetry.stopped.is_some() || reason.is_none());
            if telemetry.faults[kind] != count {
                starved += 1;
                continue;
            }
            assert_eq!(telemetry.stopped.as_deref(), reason);
            assert_eq!(rows.last().unwrap().drive_vpp > 0.0, runs_at_the_end, "configured again or not");
            return;
        }
    }
    assert!(starved < 5, "every attempt lost the controller, missed more than {count} replies or applied fewer faults");
}

struct SimulatedBoard {
    path: String,
    samples: Arc<AtomicU32>,
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SimulatedBoard {
    fn new() -> Self {
        let mut terminal = PtyLink::open().unwrap();
        let path = terminal.path().to_owned();
        let (samples, over) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicBool::new(false)));
        let (counted, is_over) = (Arc::clone(&samples), Arc::clone(&over));
        let thread = thread::spawn(move || {
            let begun = Instant::now();
            let (mut device, mut bytes, mut answer) = (HostedLink::new(), Vec::new(), Vec::new());
            while !is_over.load(Ordering::Relaxed) {
                let line = terminal.real_time_line().unwrap();
                let soon = Instant::now() + Duration::from_millis(1);
                if line.receive(soon, &mut bytes).unwrap().is_some() {
                    device.exchange(begun.elapsed(), &bytes, &mut answer).unwrap();
                    bytes.clear();
                    counted.fetch_add(1, Ordering::Relaxed);
                }
                device.advance_to(begun.elapsed(), &mut answer).unwrap();
                line.send(&answer).unwrap();
                answer.clear();
            }
        });
        Self { path, samples, is_stopped: over, thread: Some(thread) }
    }
}

impl Drop for SimulatedBoard {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

#[test]
fn a_busy_port_error_names_the_other_bench() {
    let folder = TestFolder::with_minute();
    let board = SimulatedBoard::new();
    let rig = format!("serial:{}", board.path);
    // The first bench must not lose its controller on a busy machine.
    let mut first = start_bench(folder.path(), ["run", "--rig", &rig, "--reply-timeout", "5000", "--out", "first"]);
    wait_until("the first bench never ran", || board.samples.load(Ordering::Relaxed) > 20);

    let holder = format!("in use by process {} ", first.0.id());
    folder.bench(["run", "--rig", &rig, "--out", "second"]).assert_message(5, &[&holder, "--out first"]);

    first.signal("TERM");
    first.wait_for_exit(&[143]);
    assert_eq!(folder.record("first").safe_confirmed, Some(true));
}

#[test]
fn a_run_over_tcp_is_in_real_time_and_measures_the_delay() {
    let folder = TestFolder::with_step(SETTLING);
    let rig = format!("tcp:{}", serve_board());
    let output = folder.bench(["run", "--rig", &rig, "--time-scale", "0.1", "--out", "run"]);
    let record = RunRecord::read(&folder.join("run")).unwrap();
    // A late bench or a slow line may make the verdict inconclusive, but never a failure.
    assert_ne!(record.verdict, Verdict::Fail, "{}", output.text());
    output.assert_exit(if record.verdict == Verdict::Pass { 0 } else { 3 });
    assert_eq!((record.clock, record.safe_confirmed), (ClockKind::RealTime, Some(true)));
    assert_eq!(record.rig.name, rig);
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    assert!(timing.loop_delay_us.is_some_and(|delay| delay.max > 0.0), "{timing:?}");
}

#[test]
fn an_address_without_a_server_cannot_be_reached() {
    let folder = TestFolder::with_step(SETTLING);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    for kind in ["tcp", "rfc2217"] {
        let rig = format!("{kind}:{address}");
        folder.bench(["run", "--rig", &rig, "--out", kind]).assert_message(5, &[&address]);
    }
}
