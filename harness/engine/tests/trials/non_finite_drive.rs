use crate::fixtures::{FIG13, LOCKSTEP, plan, run_with_link};
use platebench_engine::rejudge;
use platebench_model::record::{Cause, Exclusion, NonFiniteDrive, RunRecord, ScenarioRecord, TrialReason, Verdict};
use platebench_model::scenario::Scenario;
use platebench_test_kit::{commands, link_with_changed_answers, load_scenario};
use platebench_wire::{Command, ControllerState};
use std::fs;
use std::path::Path;
use std::time::Duration;

fn assert_finite_numbers(folder: &Path) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            assert_finite_numbers(&path);
            continue;
        }
        // The reason of the failure contains NaN as a word, so this text is removed.
        let text = fs::read_to_string(&path).unwrap().to_lowercase().replace("nan or infinite", "");
        let mut words = text.split(|c: char| !c.is_alphanumeric());
        assert!(words.all(|word| !["nan", "inf", "infinity"].contains(&word)), "{}", path.display());
    }
}

fn run_with_drive(drive: f32) -> RunRecord {
    let (live, again) = run_and_rejudge(load_scenario(FIG13), drive, 10);
    assert_eq!(live.scenarios, again);
    live
}

/// Replaces the drive of every command after `from_ms`, except in the confirmation of 0 V.
fn run_and_rejudge(scenario: Scenario, drive_vpp: f32, from_ms: u64) -> (RunRecord, Vec<ScenarioRecord>) {
    let folder = tempfile::tempdir().unwrap();
    let link = link_with_changed_answers(move |now, _, answers| {
        let is_changed =
            |command: &&mut Command| now >= Duration::from_millis(from_ms) && command.state != ControllerState::Safe;
        commands(answers).filter(is_changed).for_each(|command| command.drive_vpp = drive_vpp);
    });
    let out = folder.path().join("run");
    let live = run_with_link(&plan(vec![scenario], LOCKSTEP), &out, || link.clone()).unwrap();
    assert_finite_numbers(&out);
    (live, rejudge(&out, None).unwrap().scenarios)
}

#[test]
fn a_non_finite_drive_is_the_reason_of_the_failure() {
    for drive in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let record = run_with_drive(drive);
        let trial = &record.scenarios[0].trials[0];
        assert_eq!(trial.telemetry.not_finite, Some(NonFiniteDrive { at_s: 0.01, count: 50 }), "{drive}");
        assert_eq!(trial.diverged_at_s, Some(0.01));
        assert_eq!(record.verdict, Verdict::Fail);
        let reasons: Vec<_> = record.scenarios[0]
            .expectations
            .iter()
            .filter_map(|it| it.reason.as_ref())
            .map(ToString::to_string)
            .collect();
        let settling =
            "trial 0: diverged at t = 10.0 ms: the drive command was NaN or infinite: never stays inside the band";
        assert!(reasons.iter().any(|reason| reason == settling), "{reasons:#?}");
        assert!(reasons.iter().all(|reason| reason.matches("NaN or infinite").count() == 1), "{reasons:#?}");
    }
}

/// The bench clamps such a drive to the range from 0 V to the drive limit.
#[test]
fn a_drive_beyond_the_amplifier_is_no_divergence() {
    for drive in [f32::MAX, f32::MIN] {
        let record = run_with_drive(drive);
        let trial = &record.scenarios[0].trials[0];
        assert_eq!((record.verdict, trial.telemetry.not_finite, trial.diverged_at_s), (Verdict::Fail, None, None));
    }
}

/// The plate rests only because the bench replaces NaN by 0 V, so the trial must fail.
#[test]
fn a_stop_with_a_non_finite_drive_fails() {
    // The controller stops at 41 ms.
    let verdict = |drive| run_and_rejudge(load_scenario("faults/noise-storm.toml"), drive, 42).0.verdict;
    assert_eq!([verdict(0.0), verdict(f32::NAN)], [Verdict::Pass, Verdict::Fail]);
}

#[test]
fn a_plate_that_overflows_excludes_the_trial() {
    let mut scenario = load_scenario(FIG13);
    scenario.plate.damping_ratio = vec![[0.0, 1e-300]];
    let (live, _) = run_and_rejudge(scenario, 100.0, 10);
    let trial = &live.scenarios[0].trials[0];
    assert_eq!((live.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Bench)));
    assert!(matches!(trial.reason, Some(TrialReason::Excluded(Exclusion::EarlyEnd { .. }))), "{:?}", trial.reason);
}
