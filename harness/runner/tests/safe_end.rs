//! However a trial comes to grief, the controller is asked for 0 V, and the record says whether it confirmed that.

#![allow(clippy::unwrap_used, clippy::panic, clippy::expect_used, reason = "helpers of tests")]

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_record::RunRecord;
use platebench_rig::{BoxedLink, HostedLink, Link, LinkError, RealTimeLine, WallClockLink};
use platebench_runner::{Clock, Pacing, RunError, RunHooks, RunPlan, TimeBase, run};
use platebench_scenario::{Scenario, load};
use platebench_wire::{ControllerState, Message, Packet, PacketReader};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What goes wrong once twenty samples have gone well.
#[derive(Debug, Clone, Copy, PartialEq)]
enum InjectedFailure {
    PanicOnSend,
    PanicOnReceive,
    PanicOnExchange,
    LostOnSend,
    LostOnReceive,
    LostOnExchange,
    /// As `LostOnSend`, and what comes later does not arrive either.
    LostPermanently,
    /// As `PanicOnSend`, and asking for 0 V panics too.
    PanicPermanently,
}

/// What a controller lived through.
#[derive(Debug, Clone, Copy, PartialEq)]
enum LinkEvent {
    Command { drive_vpp: f32 },
    Failure,
    Safe { drive_vpp: f32, state: ControllerState },
}

type EventLog = Arc<Mutex<Vec<LinkEvent>>>;

/// A hosted controller on a line that comes to grief.
struct FailingLink {
    inner: BoxedLink,
    failure: InjectedFailure,
    samples: u32,
    failed: bool,
    log: EventLog,
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}

fn contains_message(bytes: &[u8], what: impl Fn(&Message) -> bool) -> bool {
    packets(bytes).iter().any(|packet| what(&packet.message))
}

impl FailingLink {
    fn append_event(&self, seen: LinkEvent) {
        self.log.lock().unwrap().push(seen);
    }

    fn fail(&mut self, panics: bool) -> Result<(), LinkError> {
        self.failed = true;
        self.append_event(LinkEvent::Failure);
        assert!(!panics, "a fault of the link's own");
        Err(LinkError::Disconnected("on purpose".to_owned()))
    }

    fn should_fail(&self, grief: InjectedFailure) -> bool {
        self.samples > 20 && !self.failed && self.failure == grief
    }

    fn append_commands(&self, bytes: &[u8]) {
        for packet in packets(bytes) {
            if let Message::Command(command) = packet.message {
                self.append_event(LinkEvent::Command { drive_vpp: command.drive_vpp });
            }
        }
    }
}

impl Link for FailingLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let safe = packets(bytes).into_iter().find(|packet| packet.message == Message::Safe);
        if self.failed && self.failure == InjectedFailure::LostPermanently {
            return Err(LinkError::Disconnected("still".to_owned()));
        }
        assert!(!(self.failed && self.failure == InjectedFailure::PanicPermanently), "again");
        self.samples += u32::from(contains_message(bytes, |message| matches!(message, Message::Sample(_))));
        if self.should_fail(InjectedFailure::PanicOnExchange) {
            self.fail(true)?;
        }
        if self.should_fail(InjectedFailure::LostOnExchange) {
            self.fail(false)?;
        }
        let from = answer.len();
        let delay = self.inner.exchange(now, bytes, answer)?;
        // Commands that were still on their way come before the answer.
        for packet in packets(&answer[from..]) {
            match (packet.message, safe) {
                (Message::Command(command), Some(safe)) if packet.sequence == safe.sequence => {
                    self.append_event(LinkEvent::Safe { drive_vpp: command.drive_vpp, state: command.state });
                }
                (Message::Command(command), None) => {
                    self.append_event(LinkEvent::Command { drive_vpp: command.drive_vpp });
                }
                _ => {}
            }
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        self.inner.real_time_line().is_some().then_some(self as &mut dyn RealTimeLine)
    }
}

impl RealTimeLine for FailingLink {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples += u32::from(contains_message(bytes, |message| matches!(message, Message::Sample(_))));
        if self.should_fail(InjectedFailure::PanicOnSend) || self.should_fail(InjectedFailure::PanicPermanently) {
            self.fail(true)?;
        }
        if self.should_fail(InjectedFailure::LostOnSend) || self.should_fail(InjectedFailure::LostPermanently) {
            self.fail(false)?;
        }
        self.inner.real_time_line().unwrap().send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if self.should_fail(InjectedFailure::PanicOnReceive) {
            self.fail(true)?;
        }
        if self.should_fail(InjectedFailure::LostOnReceive) {
            self.fail(false)?;
        }
        let from = bytes.len();
        let arrived = self.inner.real_time_line().unwrap().receive(until, bytes)?;
        self.append_commands(&bytes[from..]);
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
fn run_with_failure(grief: InjectedFailure) -> (Result<RunRecord, RunError>, RunRecord, Vec<LinkEvent>) {
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let lockstep = matches!(grief, InjectedFailure::PanicOnExchange | InjectedFailure::LostOnExchange);
    let plan = RunPlan {
        scenarios: vec![scenario()],
        jobs: 1,
        clock: if lockstep {
            Clock::Lockstep { wire_time: false }
        } else {
            Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench })
        },
        own_clock: false,
        rig: "fragile".to_owned(),
        overrides: Overrides::default(),
    };
    let diary = EventLog::default();
    let connect = || {
        let inner: BoxedLink =
            if lockstep { Box::new(HostedLink::new()) } else { Box::new(WallClockLink::new(HostedLink::new())) };
        let link = FailingLink { inner, failure: grief, samples: 0, failed: false, log: Arc::clone(&diary) };
        Ok(Box::new(link) as BoxedLink)
    };
    let ended = run(&plan, &run_folder, &connect, RunHooks::default());
    let record = RunRecord::read(run_folder.path()).unwrap();
    let seen = diary.lock().unwrap().clone();
    (ended, record, seen)
}

/// The controller drove the plate, came to grief, and said 0 V when it was asked to after that.
#[track_caller]
fn assert_ends_at_zero_drive(seen: &[LinkEvent]) {
    let grief = seen.iter().position(|seen| *seen == LinkEvent::Failure).expect("it came to grief");
    let drove = |seen: &LinkEvent| matches!(seen, LinkEvent::Command { drive_vpp } if *drive_vpp > 100.0);
    assert!(seen[..grief].iter().any(drove), "the plate was driven before");
    let after = &seen[grief + 1..];
    assert_eq!(
        after.first(),
        Some(&LinkEvent::Safe { drive_vpp: 0.0, state: ControllerState::Safe }),
        "the next thing it is told"
    );
    assert!(after.iter().all(|seen| matches!(seen, LinkEvent::Safe { drive_vpp: 0.0, .. })), "{after:?}");
}

#[test]
fn a_panic_in_the_loop_leaves_the_plate_at_0_v_and_is_the_bench_s_own_fault() {
    for grief in [InjectedFailure::PanicOnSend, InjectedFailure::PanicOnReceive, InjectedFailure::PanicOnExchange] {
        let (ended, record, seen) = run_with_failure(grief);
        let error = ended.expect_err("a panic is no result");
        assert!(matches!(&error, RunError::Internal(why) if why.contains("the link's own")), "{grief:?}: {error}");
        assert_ends_at_zero_drive(&seen);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), false), "{grief:?}");
    }
}

#[test]
fn an_error_of_the_line_leaves_the_plate_at_0_v() {
    for grief in [InjectedFailure::LostOnSend, InjectedFailure::LostOnReceive, InjectedFailure::LostOnExchange] {
        let (ended, record, seen) = run_with_failure(grief);
        let trial = &ended.unwrap().scenarios[0].trials[0];
        assert!(trial.telemetry.ended.as_ref().is_some_and(|why| why.contains("on purpose")), "{grief:?}");
        assert_ends_at_zero_drive(&seen);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), true), "{grief:?}");
    }
}

#[test]
fn a_controller_that_is_gone_confirms_nothing_and_the_record_says_so() {
    let (ended, record, seen) = run_with_failure(InjectedFailure::LostPermanently);
    assert!(ended.is_ok_and(|record| record.has_lost_controller()));
    assert_eq!(record.safe_confirmed, Some(false));
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    assert!(!timing.safe_confirmed);
    assert!(!seen.iter().any(|seen| matches!(seen, LinkEvent::Safe { .. })));
}

#[test]
fn a_link_that_panics_whatever_it_is_asked_ends_the_run_all_the_same() {
    let (ended, record, _) = run_with_failure(InjectedFailure::PanicPermanently);
    assert!(matches!(ended, Err(RunError::Internal(_))));
    assert_eq!((record.safe_confirmed, record.complete), (Some(false), false));
}
