//! A board that is not what it was: restarted within a trial, or another one on the same line.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_record::{Cause, RunRecord, Verdict};
use platebench_rig::{BoxedLink, HostedLink, Link, LinkError, RealTimeLine, WallClockLink};
use platebench_runner::{Clock, Pacing, RunError, RunHooks, RunPlan, TimeBase, run};
use platebench_scenario::load;
use platebench_wire::{Message, Packet, PacketReader};
use std::path::Path;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

/// Samples that go well.
const SAMPLES_BEFORE_FAILURE: u32 = 20;
const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
const REAL_TIME: Clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });

/// What becomes of a board after `GOOD` samples.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BoardFailure {
    Restarted,
    Unplugged,
}

struct FailingBoard {
    inner: BoxedLink,
    new_link: fn() -> BoxedLink,
    number: u8,
    failure: Option<BoardFailure>,
    samples: u32,
}

impl FailingBoard {
    fn count_and_fail(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples +=
            packets(bytes).iter().filter(|packet| matches!(packet.message, Message::Sample(_))).count() as u32;
        if self.samples > SAMPLES_BEFORE_FAILURE && self.failure == Some(BoardFailure::Unplugged) {
            return Err(LinkError::Disconnected("unplugged".to_owned()));
        }
        if self.samples > SAMPLES_BEFORE_FAILURE && self.failure.take() == Some(BoardFailure::Restarted) {
            self.inner = (self.new_link)();
        }
        Ok(())
    }
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}

impl Link for FailingBoard {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.count_and_fail(bytes)?;
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

    fn advance_to(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, said)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        self.inner.real_time_line().is_some().then_some(self as &mut dyn RealTimeLine)
    }
}

impl RealTimeLine for FailingBoard {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.count_and_fail(bytes)?;
        self.inner.real_time_line().unwrap().send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.inner.real_time_line().unwrap().receive(until, bytes)
    }
}

/// Two trials on boards with these numbers, one after the other, the first of which meets its fate.
fn run_on_boards(clock: Clock, fate: BoardFailure, numbers: [u8; 2]) -> (Result<RunRecord, RunError>, RunRecord) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
    let mut scenario = load(&path, "fig13-closed-loop.toml").unwrap_or_else(|fault| panic!("{fault}"));
    (scenario.trials.count, scenario.trials.max_count) = (2, 2);
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let (rig, overrides) = ("boards".to_owned(), Overrides::default());
    let plan = RunPlan { scenarios: vec![scenario], jobs: 1, clock, own_clock: false, rig, overrides };
    let connected = AtomicU8::new(0);
    let again: fn() -> BoxedLink = if clock == LOCKSTEP {
        || Box::new(HostedLink::new())
    } else {
        || Box::new(WallClockLink::new(HostedLink::new()))
    };
    let connect = || {
        let count = connected.fetch_add(1, Ordering::Relaxed);
        let number = numbers[usize::from(count.min(1))];
        Ok(Box::new(FailingBoard {
            inner: again(),
            new_link: again,
            number,
            failure: (count == 0).then_some(fate),
            samples: 0,
        }) as BoxedLink)
    };
    let ended = run(&plan, &run_folder, &connect, RunHooks::default());
    (ended, RunRecord::read(run_folder.path()).unwrap())
}

#[test]
fn a_board_that_restarted_within_a_trial_leaves_it_undecided() {
    for clock in [LOCKSTEP, REAL_TIME] {
        let (ended, record) = run_on_boards(clock, BoardFailure::Restarted, [1, 1]);
        assert!(ended.is_ok(), "{clock:?}");
        let trials = &record.scenarios[0].trials;
        let ended: Vec<_> = trials.iter().map(|trial| trial.telemetry.ended.clone().unwrap_or_default()).collect();
        assert_eq!(ended, ["the controller was restarted in the middle of a trial", ""], "{clock:?}");
        assert_eq!(trials[0].cause, Some(Cause::Rig), "{clock:?}");
        assert_eq!((record.verdict, record.has_lost_controller()), (Verdict::Inconclusive, true), "{clock:?}");
    }
}

#[test]
fn the_same_board_may_come_back_and_another_one_may_not() {
    let (ended, record) = run_on_boards(LOCKSTEP, BoardFailure::Unplugged, [1, 1]);
    assert!(ended.is_ok_and(|record| record.scenarios[0].trials.len() == 2 && record.has_lost_controller()));
    assert!(record.complete);
    let (ended, record) = run_on_boards(LOCKSTEP, BoardFailure::Unplugged, [1, 2]);
    let error = ended.unwrap_err();
    assert!(matches!(error, RunError::DifferentController { .. }), "{error}");
    let told = error.to_string();
    assert!(told.contains("number 020000") && told.contains("began with platebench-host"), "{told}");
    // The board that was unplugged confirmed nothing; the one that is there was asked for 0 V too.
    assert_eq!((record.complete, record.safe_confirmed), (false, Some(false)));
}
