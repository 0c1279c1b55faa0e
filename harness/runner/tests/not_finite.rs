//! A controller whose drive is no number: the plate rests, the record says why, and no file of the run holds such a value.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_record::{
    Cause, Exclusion, NonFiniteDrive, Overrides, RunFolder, RunRecord, ScenarioRecord, TrialReason, Verdict,
};
use platebench_rig::{HostedLink, Link, LinkError};
use platebench_runner::{Clock, RunHooks, RunPlan, rejudge, run};
use platebench_scenario::{Scenario, load};
use platebench_wire::{Message, PacketReader};
use std::fs;
use std::path::Path;
use std::time::Duration;

const FIG13: &str = "../../scenarios/paper/fig13-closed-loop.toml";

/// Answers `drive` instead of what the law wants, from a control instant on.
struct FixedDriveLink {
    inner: HostedLink,
    drive_vpp: f32,
    from: Duration,
}

impl Link for FixedDriveLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut plain = Vec::new();
        let took = self.inner.exchange(now, bytes, &mut plain)?;
        for packet in PacketReader::new().packets(&plain) {
            let mut packet = packet.unwrap();
            if let Message::Command(command) = &mut packet.message
                && now >= self.from
            {
                command.drive_vpp = self.drive_vpp;
            }
            answer.extend_from_slice(packet.encode().as_bytes());
        }
        Ok(took)
    }

    fn advance_to(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }
}

/// Asserts that no file of the run holds a NaN or an infinity.
fn assert_finite_numbers(folder: &Path) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            assert_finite_numbers(&path);
            continue;
        }
        // The reason itself names NaN.
        let text = fs::read_to_string(&path).unwrap().to_lowercase().replace("nan or infinite", "");
        let mut words = text.split(|c: char| !c.is_alphanumeric());
        assert!(words.all(|word| !["nan", "inf", "infinity"].contains(&word)), "{}", path.display());
    }
}

fn run_with_drive(drive: f32) -> RunRecord {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(FIG13);
    let (live, again) = run_and_rejudge(load(&path, "fig13.toml").unwrap(), drive, 10);
    assert_eq!(live.scenarios, again);
    live
}

/// The record of a run over [`Instead`], and its scenarios as they are judged again.
fn run_and_rejudge(scenario: Scenario, drive: f32, from_ms: u64) -> (RunRecord, Vec<ScenarioRecord>) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let plan = RunPlan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides: Overrides::default(),
    };
    let run_folder = RunFolder::create(Some(&out)).unwrap();
    let connect = || {
        let link = FixedDriveLink { inner: HostedLink::new(), drive_vpp: drive, from: Duration::from_millis(from_ms) };
        Ok(Box::new(link) as Box<dyn Link>)
    };
    let live = run(&plan, &run_folder, &connect, RunHooks::default()).unwrap();
    assert_finite_numbers(&out);
    let again = rejudge(&out, None).unwrap().scenarios;
    (live, again)
}

#[test]
fn a_drive_that_is_no_number_is_named_as_the_reason() {
    for drive in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let record = run_with_drive(drive);
        let trial = &record.scenarios[0].trials[0];
        // One a millisecond, from 10 to 59 ms.
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
    }
}

/// More than the amplifier gives is the limit, less than nothing is 0 V: both are numbers.
#[test]
fn a_drive_beyond_the_amplifier_is_no_divergence() {
    for drive in [f32::MAX, f32::MIN] {
        let record = run_with_drive(drive);
        let trial = &record.scenarios[0].trials[0];
        assert_eq!((record.verdict, trial.telemetry.not_finite, trial.diverged_at_s), (Verdict::Fail, None, None));
    }
}

/// It says that it has stopped, and the plate rests: because the bench gave 0 V for what was no drive.
#[test]
fn a_stop_at_a_drive_that_is_no_number_is_none() {
    let storm = || {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/faults/noise-storm.toml");
        load(&path, "noise-storm.toml").unwrap()
    };
    // It stops at 41 ms.
    let verdict = |drive| run_and_rejudge(storm(), drive, 42).0.verdict;
    assert_eq!([verdict(0.0), verdict(f32::NAN)], [Verdict::Pass, Verdict::Fail]);
}

/// No file can ask for such a plate; whoever makes one all the same has a trace that ends where it stops being numbers, and a trial that does not count.
#[test]
fn a_plate_that_cannot_be_computed_is_the_bench_s_fault() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(FIG13);
    let mut scenario = load(&path, "fig13.toml").unwrap();
    scenario.plate.damping_ratio = vec![[0.0, 1e-300]];
    let (live, _) = run_and_rejudge(scenario, 100.0, 10);
    let trial = &live.scenarios[0].trials[0];
    assert_eq!((live.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Bench)));
    assert!(matches!(trial.reason, Some(TrialReason::Excluded(Exclusion::EarlyEnd { .. }))), "{:?}", trial.reason);
}
