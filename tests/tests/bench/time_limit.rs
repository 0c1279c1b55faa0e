//! Tests what a run with a time limit of a scenario plays and records.

use crate::controller_end::{Change, controller};
use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, step_text};
use platebench_model::record::{Cause, Reason, RunRecord, Verdict};
use rstest::rstest;

/// A trial takes longer than 20 µs, so this number takes longer than 2 s.
const TRIALS: &str = "100000";

/// Judges the stored traces again. Record and result must agree.
#[track_caller]
fn assert_judged_again(folder: &TestFolder, run: &str, exit: i32) -> RunRecord {
    let record = folder.record(run);
    let judged = folder.bench(["report", run, "--rejudge", "--format", "json"]).assert_exit(exit).json();
    for (scenario, expected) in judged["scenarios"].as_array().unwrap().iter().zip(&record.scenarios) {
        assert_eq!(scenario["expectations"], serde_json::to_value(&expected.expectations).unwrap());
        assert_eq!(scenario["time_limit_s"], serde_json::to_value(expected.time_limit_s).unwrap());
    }
    record
}

#[test]
fn a_time_limit_ends_its_scenario_only() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &format!("timeout_s = 1e-6\n{}", step_text(SETTLING)));
    folder.write_scenario("b.toml", &step_text(SETTLING));
    folder.bench(["run", "--rig", "hosted", "--out", "run"]).assert_exit(3);
    let record = assert_judged_again(&folder, "run", 3);
    let [limited, other] = &record.scenarios[..] else { panic!("{record:?}") };
    assert!(record.complete && record.safe_confirmed == Some(true));
    assert_eq!((limited.verdict, limited.trials.len(), limited.time_limit_s), (Verdict::Inconclusive, 0, Some(1e-6)));
    assert_eq!(limited.expectations[0].cause, Some(Cause::Evidence));
    let reason = Reason::TimeLimit { limit_s: 1e-6, played: 0, planned: 1 };
    assert_eq!(limited.expectations[0].reason, Some(reason));
    assert_eq!((other.verdict, other.time_limit_s), (Verdict::Pass, None));
}

#[test]
fn the_option_replaces_the_key() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &format!("timeout_s = 1e-6\n{}", step_text(SETTLING)));
    folder.bench(["run", "--rig", "hosted", "--out", "run", "--timeout", "3600"]).assert_exit(0);
}

#[rstest]
#[case::passing(SETTLING, Verdict::Inconclusive, 3)]
#[case::failing(FAILED_SETTLING, Verdict::Fail, 1)]
fn judges_the_trials_before_the_time_limit(
    #[case] expect: &str,
    #[case] verdict: Verdict,
    #[case] exit: i32,
    #[values("1", "2")] jobs: &str,
) {
    let folder = TestFolder::with_step(expect);
    let run = ["run", "--rig", "hosted", "--out", "run", "--trials", TRIALS, "--timeout", "2", "--jobs", jobs];
    folder.bench(run).assert_exit(exit).assert_stdout(&["time limit reached: 1 scenario: "]);
    let record = assert_judged_again(&folder, "run", exit);
    let scenario = &record.scenarios[0];
    assert_eq!((scenario.verdict, scenario.time_limit_s), (verdict, Some(2.0)));
    assert!(scenario.trials.len() < 100_000);
}

#[test]
fn a_controller_that_never_answers_a_sample_reaches_the_time_limit() {
    let folder = TestFolder::with_step(SETTLING);
    let change = Change::Message { kind: "SAMPLE", action: "return None" };
    let Some(rig) = controller(&folder, change) else { return };
    let run = ["run", "--rig", &rig, "--clock", "real-time", "--trials", TRIALS, "--timeout", "3", "--out", "run"];
    // On a busy machine, Python starts slowly.
    let patient = ["--reply-timeout", "5000"];
    folder.bench(run.into_iter().chain(patient)).assert_exit(3).assert_stdout(&["time limit reached: 1 scenario: "]);
    let record = assert_judged_again(&folder, "run", 3);
    assert_eq!(record.scenarios[0].time_limit_s, Some(3.0));
    assert_eq!(record.safe_confirmed, Some(true));
}
