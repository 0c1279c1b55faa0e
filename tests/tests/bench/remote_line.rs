//! Tests whole runs over TCP.

use crate::test_folder::{SETTLING, TestFolder};
use platebench_model::record::{ClockKind, RunRecord, Verdict};
use platebench_test_kit::serve_board;
use std::net::TcpListener;

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
