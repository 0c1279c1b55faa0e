//! Tests planned faults of the line in a real-time trial whose time is simulated.

use crate::fixtures::{REAL_TIME, new_link, plan, run_with_link};
use platebench_model::record::Verdict;
use platebench_model::trace::{Flags, read_trace};
use platebench_test_kit::load_scenario;
use rstest::rstest;

const STOPPED: Option<&str> = Some("no sample within the watchdog timeout");

/// `counts` are dropped messages, missed replies and lost replies.
#[rstest]
#[case::a_sample("lost-sample", "drop", [1, 1, 1], None, true)]
#[case::five_samples("five-periods-of-silence", "drop", [5, 5, 5], STOPPED, false)]
#[case::the_line("disconnect-and-reconnect", "disconnect", [31, 30, 30], STOPPED, true)]
fn wire_faults_act_in_real_time(
    #[case] name: &str,
    #[case] kind: &str,
    #[case] counts: [u64; 3],
    #[case] reason: Option<&str>,
    #[case] runs_at_the_end: bool,
) {
    let folder = tempfile::tempdir().unwrap();
    let scenario = load_scenario(&format!("faults/{name}.toml"));
    let out = folder.path().join("run");
    let record = run_with_link(&plan(vec![scenario], REAL_TIME), &out, || new_link(REAL_TIME)).unwrap();
    let trial = &record.scenarios[0].trials[0];
    let (telemetry, timing) = (&trial.telemetry, trial.telemetry.timing.as_ref().unwrap());
    assert_eq!((record.verdict, record.safe_confirmed), (Verdict::Pass, Some(true)), "{:?}", trial.reason);
    assert_eq!((telemetry.ended.as_deref(), timing.rejected_frames, timing.overruns), (None, 0, 0));
    let applied: Vec<_> = telemetry.faults.iter().map(|(kind, count)| (kind.as_str(), *count)).collect();
    assert_eq!(applied, [(kind, counts[0])]);
    assert_eq!([timing.missed_replies, timing.lost_replies], counts[1..], "{timing:?}");
    assert_eq!(telemetry.stopped.as_deref(), reason);
    let rows = read_trace(&out.join(&trial.trace)).unwrap();
    let was_at_rest = rows.iter().any(|row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0);
    assert_eq!(was_at_rest, reason.is_some());
    assert_eq!(rows.last().unwrap().drive_vpp > 0.0, runs_at_the_end, "configured again or not");
}
