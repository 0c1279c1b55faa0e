//! However a trial comes to grief, the controller is asked for 0 V, and the record says whether it confirmed that.

#![allow(clippy::unwrap_used, clippy::panic, clippy::expect_used, reason = "helpers of tests")]

use platebench_rig::{AnyLink, Hosted, Line, Link, LinkError, Paced};
use platebench_runner::{Cancel, Clock, Pace, Pacing, Plan, RunError, RunFolder, run};
use platebench_scenario::{Scenario, load};
use platebench_verdict::RunRecord;
use platebench_verdict::record::Overrides;
use platebench_wire::{FrameReader, Message, Packet, State};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What goes wrong once twenty samples have gone well.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Grief {
    PanicOnSend,
    PanicOnReceive,
    PanicOnExchange,
    LostOnSend,
    LostOnReceive,
    LostOnExchange,
    /// As `LostOnSend`, and what comes later does not arrive either.
    LostForGood,
    /// As `PanicOnSend`, and asking for 0 V panics too.
    PanicForGood,
}

/// What a controller lived through.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Seen {
    Command { drive_vpp: f32 },
    Grief,
    Safe { drive_vpp: f32, state: State },
}

type Diary = Arc<Mutex<Vec<Seen>>>;

/// A hosted controller on a line that comes to grief.
struct Fragile {
    inner: AnyLink,
    grief: Grief,
    samples: u32,
    struck: bool,
    diary: Diary,
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut reader = FrameReader::new();
    let mut found = Vec::new();
    for &byte in bytes {
        found.extend(reader.push(byte).and_then(Result::ok).and_then(|body| Packet::decode(body).ok()));
    }
    found
}

fn holds(bytes: &[u8], what: impl Fn(&Message) -> bool) -> bool {
    packets(bytes).iter().any(|packet| what(&packet.message))
}

impl Fragile {
    fn note(&self, seen: Seen) {
        self.diary.lock().unwrap().push(seen);
    }

    fn strike(&mut self, panics: bool) -> Result<(), LinkError> {
        self.struck = true;
        self.note(Seen::Grief);
        assert!(!panics, "a fault of the link's own");
        Err(LinkError::Disconnected("on purpose".to_owned()))
    }

    fn strikes(&self, grief: Grief) -> bool {
        self.samples > 20 && !self.struck && self.grief == grief
    }

    fn note_commands(&self, bytes: &[u8]) {
        for packet in packets(bytes) {
            if let Message::Command(command) = packet.message {
                self.note(Seen::Command { drive_vpp: command.drive_vpp });
            }
        }
    }
}

impl Link for Fragile {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let safe = packets(bytes).into_iter().find(|packet| packet.message == Message::Safe);
        if self.struck && self.grief == Grief::LostForGood {
            return Err(LinkError::Disconnected("still".to_owned()));
        }
        assert!(!(self.struck && self.grief == Grief::PanicForGood), "again");
        self.samples += u32::from(holds(bytes, |message| matches!(message, Message::Sample(_))));
        if self.strikes(Grief::PanicOnExchange) {
            self.strike(true)?;
        }
        if self.strikes(Grief::LostOnExchange) {
            self.strike(false)?;
        }
        let from = answer.len();
        let delay = self.inner.exchange(now, bytes, answer)?;
        // Commands that were still on their way come before the answer.
        for packet in packets(&answer[from..]) {
            match (packet.message, safe) {
                (Message::Command(command), Some(safe)) if packet.sequence == safe.sequence => {
                    self.note(Seen::Safe { drive_vpp: command.drive_vpp, state: command.state });
                }
                (Message::Command(command), None) => self.note(Seen::Command { drive_vpp: command.drive_vpp }),
                _ => {}
            }
        }
        Ok(delay)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.pass(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        self.inner.line().is_some().then_some(self as &mut dyn Line)
    }
}

impl Line for Fragile {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples += u32::from(holds(bytes, |message| matches!(message, Message::Sample(_))));
        if self.strikes(Grief::PanicOnSend) || self.strikes(Grief::PanicForGood) {
            self.strike(true)?;
        }
        if self.strikes(Grief::LostOnSend) || self.strikes(Grief::LostForGood) {
            self.strike(false)?;
        }
        self.inner.line().unwrap().send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if self.strikes(Grief::PanicOnReceive) {
            self.strike(true)?;
        }
        if self.strikes(Grief::LostOnReceive) {
            self.strike(false)?;
        }
        let from = bytes.len();
        let arrived = self.inner.line().unwrap().receive(until, bytes)?;
        self.note_commands(&bytes[from..]);
        Ok(arrived)
    }
}

fn scenario() -> Scenario {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
    let mut scenario = load(&path, "fig13-closed-loop.toml").unwrap_or_else(|fault| panic!("{fault}"));
    scenario.trials.count = 1;
    scenario
}

/// Plays one trial into grief: how the run ended, its record, what the controller saw.
fn played(grief: Grief) -> (Result<RunRecord, RunError>, RunRecord, Vec<Seen>) {
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let lockstep = matches!(grief, Grief::PanicOnExchange | Grief::LostOnExchange);
    let plan = Plan {
        scenarios: vec![scenario()],
        jobs: 1,
        clock: if lockstep {
            Clock::Lockstep { wire_time: false }
        } else {
            Clock::RealTime(Pace { time_scale: 1.0, pacing: Pacing::Bench })
        },
        own_clock: false,
        rig: "fragile".to_owned(),
        overrides: Overrides::default(),
    };
    let diary = Diary::default();
    let connect = || {
        let inner: AnyLink = if lockstep { Box::new(Hosted::new()) } else { Box::new(Paced::new(Hosted::new())) };
        let link = Fragile { inner, grief, samples: 0, struck: false, diary: Arc::clone(&diary) };
        Ok(Box::new(link) as AnyLink)
    };
    let ended = run(&plan, &run_folder, &connect, &Cancel::default(), &mut |_| {});
    let record = RunRecord::read(run_folder.path()).unwrap();
    let seen = diary.lock().unwrap().clone();
    (ended, record, seen)
}

/// The controller drove the plate, came to grief, and said 0 V when it was asked to after that.
#[track_caller]
fn assert_made_safe(seen: &[Seen]) {
    let grief = seen.iter().position(|seen| *seen == Seen::Grief).expect("it came to grief");
    let drove = |seen: &Seen| matches!(seen, Seen::Command { drive_vpp } if *drive_vpp > 100.0);
    assert!(seen[..grief].iter().any(drove), "the plate was driven before");
    let after = &seen[grief + 1..];
    assert_eq!(after.first(), Some(&Seen::Safe { drive_vpp: 0.0, state: State::Safe }), "the next thing it is told");
    assert!(after.iter().all(|seen| matches!(seen, Seen::Safe { drive_vpp: 0.0, .. })), "{after:?}");
}

#[test]
fn a_panic_in_the_loop_leaves_the_plate_at_0_v_and_is_the_bench_s_own_fault() {
    for grief in [Grief::PanicOnSend, Grief::PanicOnReceive, Grief::PanicOnExchange] {
        let (ended, record, seen) = played(grief);
        let error = ended.expect_err("a panic is no result");
        assert!(matches!(&error, RunError::Bench(why) if why.contains("the link's own")), "{grief:?}: {error}");
        assert_made_safe(&seen);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), false), "{grief:?}");
    }
}

#[test]
fn an_error_of_the_line_leaves_the_plate_at_0_v() {
    for grief in [Grief::LostOnSend, Grief::LostOnReceive, Grief::LostOnExchange] {
        let (ended, record, seen) = played(grief);
        let trial = &ended.unwrap().scenarios[0].trials[0];
        assert!(trial.telemetry.ended.as_ref().is_some_and(|why| why.contains("on purpose")), "{grief:?}");
        assert_made_safe(&seen);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), true), "{grief:?}");
    }
}

#[test]
fn a_controller_that_is_gone_confirms_nothing_and_the_record_says_so() {
    let (ended, record, seen) = played(Grief::LostForGood);
    assert!(ended.is_ok_and(|record| record.lost_a_controller()));
    assert_eq!(record.safe_confirmed, Some(false));
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    assert!(!timing.safe_confirmed);
    assert!(!seen.iter().any(|seen| matches!(seen, Seen::Safe { .. })));
}

#[test]
fn a_link_that_panics_whatever_it_is_asked_ends_the_run_all_the_same() {
    let (ended, record, _) = played(Grief::PanicForGood);
    assert!(matches!(ended, Err(RunError::Bench(_))));
    assert_eq!((record.safe_confirmed, record.complete), (Some(false), false));
}
