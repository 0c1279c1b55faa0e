//! Tests a port that two benches open, and TCP.

use crate::test_folder::{SETTLING, SLOW_REAL_TIME, TestFolder, start_bench, wait_until};
use platebench_model::record::{ClockKind, RunRecord, Verdict};
use platebench_rig::{HostedLink, Link, PtyLink};
use platebench_test_kit::{UNREACHABLE, serve_board};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

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
    let output = folder.bench(["run", "--rig", &rig, "--out", "run"].iter().chain(&SLOW_REAL_TIME[2..]));
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
    for kind in ["tcp", "rfc2217"] {
        let rig = format!("{kind}:{UNREACHABLE}");
        folder.bench(["run", "--rig", &rig, "--out", kind]).assert_message(5, &[UNREACHABLE]);
    }
}
