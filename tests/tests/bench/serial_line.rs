//! Live lines: faults of the wire in real time, and a port that two benches want.
//!
//! The machine may be busy. What load changes is asserted only of a run that says itself that it was punctual.

use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, controller_rig, exit_code, run_bench, send_signal, step_scenario,
    wait_until, workspace_root,
};
use platebench_record::{RunRecord, Telemetry, Verdict};
use platebench_rig::{HostedLink, Link, PtyLink};
use platebench_trace::{Flags, Row};
use rstest::rstest;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const STOPPED: Option<&str> = Some("no sample for five periods");

/// Plays a scenario of the suite in real time, a tenth as fast as the wall, over a program's line. The run and its trace.
fn run_with_line_fault(name: &str, out: &str) -> (RunRecord, Vec<Row>) {
    let folder = tempfile::tempdir().unwrap();
    let scenario = workspace_root().join(format!("scenarios/faults/{name}.toml"));
    let rig = controller_rig(None);
    let arguments = ["--clock", "real-time", "--time-scale", "0.1", "--rig", &rig, "--out", out];
    let output = run_bench(folder.path(), ["run", scenario.to_str().unwrap()].iter().chain(&arguments));
    let told = String::from_utf8_lossy(&output.stdout);
    let record = RunRecord::read(&folder.path().join(out)).unwrap();
    // A busy machine leaves it undecided, and no machine makes a controller fail that passes.
    assert_ne!(record.verdict, Verdict::Fail, "{told}");
    assert_eq!(exit_code(&output), if record.verdict == Verdict::Pass { 0 } else { 3 }, "{told}");
    assert_eq!(record.safe_confirmed, Some(true));
    let rows =
        platebench_trace::read_trace(&folder.path().join(out).join(&record.scenarios[0].trials[0].trace)).unwrap();
    (record, rows)
}

fn telemetry(record: &RunRecord) -> &Telemetry {
    &record.scenarios[0].trials[0].telemetry
}

#[rstest]
#[case::a_sample("lost-sample", ("drop", 1), None, true)]
#[case::five_samples("five-periods-of-silence", ("drop", 5), STOPPED, false)]
#[case::the_line("disconnect-and-reconnect", ("disconnect", 31), STOPPED, true)]
fn wire_faults_act_on_a_live_line(
    #[case] name: &str,
    #[case] (kind, count): (&str, u64),
    #[case] reason: Option<&str>,
    #[case] runs_at_the_end: bool,
) {
    for attempt in 0..5 {
        let (record, rows) = run_with_line_fault(name, &attempt.to_string());
        let telemetry = telemetry(&record);
        let timing = telemetry.timing.as_ref().unwrap();
        let struck: Vec<_> = telemetry.faults.keys().map(String::as_str).collect();
        assert!(struck.is_empty() || struck == [kind], "{struck:?}");
        assert_eq!((telemetry.ended.as_deref(), timing.refused_frames), (None, 0), "nothing else happened to the line");
        let was_at_rest = rows.iter().any(|row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0);
        assert_eq!(was_at_rest, telemetry.stopped.is_some());
        // An overrun may move a sample into a window or out of it; a reply that is missed beside the fault may stop the controller.
        if timing.overruns == 0 {
            assert_eq!(telemetry.faults[kind], count);
            // The last word of a controller that stops is struck, too, but answers nothing; and the last sample may wait at the end.
            let samples = if kind == "disconnect" { count - 1 } else { count };
            assert!((samples..=timing.missed_replies + 1).contains(&timing.lost_replies), "{timing:?}");
            assert!(telemetry.stopped.is_some() || reason.is_none());
        }
        if timing.overruns == 0 && timing.missed_replies <= count {
            assert_eq!(telemetry.stopped.as_deref(), reason);
            assert_eq!(rows.last().unwrap().drive_vpp > 0.0, runs_at_the_end, "configured anew, or not");
            return;
        }
    }
}

/// A controller at the other end of a port, until it is dropped.
struct ControllerOnAPort {
    path: String,
    samples: Arc<AtomicU32>,
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ControllerOnAPort {
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

impl Drop for ControllerOnAPort {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

#[test]
fn a_busy_port_error_names_the_other_bench() {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 100.0");
    workshop.write_scenario("s.toml", &text.replace("duration_ms = 60.0", "duration_ms = 60000.0"));
    let board = ControllerOnAPort::new();
    let rig = format!("serial:{}", board.path);
    let mut first = bench_command(workshop.path());
    let first = first.args(["run", "--rig", &rig, "--out", "first"]).stdout(Stdio::null()).stderr(Stdio::null());
    let mut first = ChildGuard(first.spawn().unwrap());
    wait_until("the first bench never played", || board.samples.load(Ordering::Relaxed) > 20);

    let second = run_bench(workshop.path(), ["run", "--rig", &rig, "--out", "second"]);
    let told = String::from_utf8_lossy(&second.stderr);
    assert_eq!(exit_code(&second), 5, "{told}");
    assert!(told.contains(&format!("in use by process {} ", first.0.id())), "{told}");
    assert!(told.contains("--out first"), "with its command line: {told}");

    send_signal(&first.0, "TERM");
    wait_until("the first bench does not end", || first.0.try_wait().unwrap().is_some());
    assert_eq!(first.0.wait().unwrap().code(), Some(143), "undisturbed until then");
    assert_eq!(RunRecord::read(&workshop.path().join("first")).unwrap().safe_confirmed, Some(true));
}
