//! A board that is not what it was: restarted within a trial, or another one on the same line.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_rig::{AnyLink, Hosted, Line, Link, LinkError, Paced};
use platebench_runner::{Cancel, Clock, Pace, Pacing, Plan, RunError, RunFolder, run};
use platebench_scenario::load;
use platebench_verdict::record::Overrides;
use platebench_verdict::{Cause, RunRecord, Verdict};
use platebench_wire::{FrameReader, Message, Packet};
use std::path::Path;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

/// Samples that go well.
const GOOD: u32 = 20;
const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
const REAL_TIME: Clock = Clock::RealTime(Pace { time_scale: 1.0, pacing: Pacing::Bench });

/// What becomes of a board after `GOOD` samples.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fate {
    Restarted,
    Unplugged,
}

struct Board {
    inner: AnyLink,
    again: fn() -> AnyLink,
    number: u8,
    fate: Option<Fate>,
    samples: u32,
}

impl Board {
    fn live_through(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples +=
            packets(bytes).iter().filter(|packet| matches!(packet.message, Message::Sample(_))).count() as u32;
        if self.samples > GOOD && self.fate == Some(Fate::Unplugged) {
            return Err(LinkError::Disconnected("unplugged".to_owned()));
        }
        if self.samples > GOOD && self.fate.take() == Some(Fate::Restarted) {
            self.inner = (self.again)();
        }
        Ok(())
    }
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut reader = FrameReader::new();
    bytes.iter().filter_map(|&byte| Packet::decode(reader.push(byte)?.ok()?).ok()).collect()
}

impl Link for Board {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.live_through(bytes)?;
        let mut said = Vec::new();
        let delay = self.inner.exchange(now, bytes, &mut said)?;
        for packet in &mut packets(&said) {
            if let Message::Identity(identity) = &mut packet.message {
                identity.unique[0] = self.number;
            }
            answer.extend(packet.encode().as_bytes());
        }
        Ok(delay)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.pass(now, said)
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        self.inner.line().is_some().then_some(self as &mut dyn Line)
    }
}

impl Line for Board {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.live_through(bytes)?;
        self.inner.line().unwrap().send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.inner.line().unwrap().receive(until, bytes)
    }
}

/// Two trials on boards with these numbers, one after the other, the first of which meets its fate.
fn played(clock: Clock, fate: Fate, numbers: [u8; 2]) -> (Result<RunRecord, RunError>, RunRecord) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
    let mut scenario = load(&path, "fig13-closed-loop.toml").unwrap_or_else(|fault| panic!("{fault}"));
    (scenario.trials.count, scenario.trials.max_count) = (2, 2);
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let (rig, overrides) = ("boards".to_owned(), Overrides::default());
    let plan = Plan { scenarios: vec![scenario], jobs: 1, clock, own_clock: false, rig, overrides };
    let connected = AtomicU8::new(0);
    let again: fn() -> AnyLink =
        if clock == LOCKSTEP { || Box::new(Hosted::new()) } else { || Box::new(Paced::new(Hosted::new())) };
    let connect = || {
        let count = connected.fetch_add(1, Ordering::Relaxed);
        let number = numbers[usize::from(count.min(1))];
        Ok(Box::new(Board { inner: again(), again, number, fate: (count == 0).then_some(fate), samples: 0 }) as AnyLink)
    };
    let ended = run(&plan, &run_folder, &connect, &Cancel::default(), &mut |_| {});
    (ended, RunRecord::read(run_folder.path()).unwrap())
}

#[test]
fn a_board_that_restarted_within_a_trial_leaves_it_undecided() {
    for clock in [LOCKSTEP, REAL_TIME] {
        let (ended, record) = played(clock, Fate::Restarted, [1, 1]);
        assert!(ended.is_ok(), "{clock:?}");
        let trials = &record.scenarios[0].trials;
        let ended: Vec<_> = trials.iter().map(|trial| trial.telemetry.ended.clone().unwrap_or_default()).collect();
        assert_eq!(ended, ["the controller was restarted in the middle of a trial", ""], "{clock:?}");
        assert_eq!(trials[0].cause, Some(Cause::Rig), "{clock:?}");
        assert_eq!((record.verdict, record.lost_a_controller()), (Verdict::Inconclusive, true), "{clock:?}");
    }
}

#[test]
fn the_same_board_may_come_back_and_another_one_may_not() {
    let (ended, record) = played(LOCKSTEP, Fate::Unplugged, [1, 1]);
    assert!(ended.is_ok_and(|record| record.scenarios[0].trials.len() == 2 && record.lost_a_controller()));
    assert!(record.complete);
    let (ended, record) = played(LOCKSTEP, Fate::Unplugged, [1, 2]);
    let error = ended.unwrap_err();
    assert!(matches!(error, RunError::OtherController { .. }), "{error}");
    let told = error.to_string();
    assert!(told.contains("number 020000") && told.contains("began with platebench-host"), "{told}");
    // The board that was unplugged confirmed nothing; the one that is there was asked for 0 V too.
    assert_eq!((record.complete, record.safe_confirmed), (false, Some(false)));
}
