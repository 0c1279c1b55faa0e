//! A controller whose drive is no number: the plate rests, the record says why, and no file of the run holds such a value.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_rig::{Hosted, Link, LinkError};
use platebench_runner::{Cancel, Clock, Plan, RunFolder, rejudge, run};
use platebench_scenario::{Scenario, load};
use platebench_verdict::record::{NotFinite, Overrides};
use platebench_verdict::{Cause, RunRecord, ScenarioRecord, Verdict};
use platebench_wire::{FrameReader, Message, Packet};
use std::fs;
use std::path::Path;
use std::time::Duration;

const FIG13: &str = "../../scenarios/paper/fig13-closed-loop.toml";

/// Answers `drive` instead of what the law wants, from a control instant on.
struct Instead {
    inner: Hosted,
    drive: f32,
    from: Duration,
}

impl Link for Instead {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut plain = Vec::new();
        let took = self.inner.exchange(now, bytes, &mut plain)?;
        let mut reader = FrameReader::new();
        for byte in plain {
            let Some(body) = reader.push(byte) else { continue };
            let mut packet = Packet::decode(body.unwrap()).unwrap();
            if let Message::Command(command) = &mut packet.message
                && now >= self.from
            {
                command.drive_vpp = self.drive;
            }
            answer.extend_from_slice(packet.encode().as_bytes());
        }
        Ok(took)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.pass(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }
}

/// Every file of the run: no number in it is none. Words of the kind may stand in a sentence.
fn holds_numbers_only(folder: &Path) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            holds_numbers_only(&path);
            continue;
        }
        let text = fs::read_to_string(&path).unwrap().to_lowercase();
        let mut words = text.split(|c: char| !c.is_alphanumeric());
        assert!(words.all(|word| !["nan", "inf", "infinity"].contains(&word)), "{}", path.display());
    }
}

fn played_with(drive: f32) -> RunRecord {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(FIG13);
    let (live, again) = played(load(&path, "fig13.toml").unwrap(), drive, 10);
    assert_eq!(live.scenarios, again);
    live
}

/// The record of a run over [`Instead`], and its scenarios as they are judged again.
fn played(scenario: Scenario, drive: f32, from_ms: u64) -> (RunRecord, Vec<ScenarioRecord>) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let plan = Plan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides: Overrides::default(),
    };
    let run_folder = RunFolder::create(Some(&out)).unwrap();
    let connect = || {
        let link = Instead { inner: Hosted::new(), drive, from: Duration::from_millis(from_ms) };
        Ok(Box::new(link) as Box<dyn Link>)
    };
    let live = run(&plan, &run_folder, &connect, &Cancel::default(), &mut |_| {}).unwrap();
    holds_numbers_only(&out);
    let again = rejudge(&out, None).unwrap().scenarios;
    (live, again)
}

#[test]
fn a_drive_that_is_no_number_is_named_as_the_reason() {
    for drive in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let record = played_with(drive);
        let trial = &record.scenarios[0].trials[0];
        // One a millisecond, from 10 to 59 ms.
        assert_eq!(trial.telemetry.not_finite, Some(NotFinite { at_s: 0.01, count: 50 }), "{drive}");
        assert_eq!(trial.diverged_at_s, Some(0.01));
        assert_eq!(record.verdict, Verdict::Fail);
        let reasons: Vec<_> = record.scenarios[0].expectations.iter().filter_map(|it| it.reason.as_deref()).collect();
        let settling =
            "trial 0: diverged at t = 10.0 ms: the commanded drive is not a finite number: never stays inside the band";
        assert!(reasons.contains(&settling), "{reasons:#?}");
    }
}

/// More than the amplifier gives is the limit, less than nothing is 0 V: both are numbers.
#[test]
fn a_drive_beyond_the_amplifier_is_no_divergence() {
    for drive in [f32::MAX, f32::MIN] {
        let record = played_with(drive);
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
    let verdict = |drive| played(storm(), drive, 42).0.verdict;
    assert_eq!([verdict(0.0), verdict(f32::NAN)], [Verdict::Pass, Verdict::Fail]);
}

/// No file can ask for such a plate; whoever makes one all the same has a trace that ends where it stops being numbers, and a trial that does not count.
#[test]
fn a_plate_that_cannot_be_computed_is_the_bench_s_fault() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(FIG13);
    let mut scenario = load(&path, "fig13.toml").unwrap();
    scenario.plate.damping_ratio = vec![[0.0, 1e-300]];
    let (live, _) = played(scenario, 100.0, 10);
    let trial = &live.scenarios[0].trials[0];
    assert_eq!((live.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Bench)));
    assert!(trial.reason.as_ref().is_some_and(|reason| reason.starts_with("the trace ends at ")), "{:?}", trial.reason);
}
