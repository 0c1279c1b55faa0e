use crate::fixtures::{FIG13, LOCKSTEP, REAL_TIME, new_link, plan, run_with_link};
use platebench_engine::RunError;
use platebench_model::record::RunRecord;
use platebench_rig::{BoxedLink, Link, LinkError, RealTimeLine};
use platebench_test_kit::{load_scenario, packets};
use platebench_wire::{ControllerState, Message};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy, PartialEq)]
enum InjectedFailure {
    PanicOnSend,
    PanicOnReceive,
    PanicOnExchange,
    LostOnSend,
    LostOnReceive,
    LostOnExchange,
    LostPermanently,
    PanicPermanently,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum LinkEvent {
    Command { drive_vpp: f32 },
    Failure,
    Safe { drive_vpp: f32, state: ControllerState },
}

type EventLog = Arc<Mutex<Vec<LinkEvent>>>;

struct FailingLink {
    inner: BoxedLink,
    failure: InjectedFailure,
    samples: u32,
    failed: bool,
    log: EventLog,
}

fn has_sample(bytes: &[u8]) -> bool {
    packets(bytes).iter().any(|packet| matches!(packet.message, Message::Sample(_)))
}

impl FailingLink {
    fn append_event(&self, event: LinkEvent) {
        self.log.lock().unwrap().push(event);
    }

    fn fail(&mut self, panics: bool) -> Result<(), LinkError> {
        self.failed = true;
        self.append_event(LinkEvent::Failure);
        assert!(!panics, "a planted panic of the link");
        Err(LinkError::Disconnected("on purpose".to_owned()))
    }

    fn should_fail(&self, failure: InjectedFailure) -> bool {
        self.samples > 20 && !self.failed && self.failure == failure
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
        self.samples += u32::from(has_sample(bytes));
        if self.should_fail(InjectedFailure::PanicOnExchange) {
            self.fail(true)?;
        }
        if self.should_fail(InjectedFailure::LostOnExchange) {
            self.fail(false)?;
        }
        let from = answer.len();
        let delay = self.inner.exchange(now, bytes, answer)?;
        // Commands to earlier samples may arrive before the answer to the request for 0 V.
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

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        self.inner.real_time_line().is_some().then_some(self as &mut dyn RealTimeLine)
    }
}

impl RealTimeLine for FailingLink {
    fn now(&mut self) -> Instant {
        self.inner.real_time_line().unwrap().now()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples += u32::from(has_sample(bytes));
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

fn run_with_failure(failure: InjectedFailure) -> (Result<RunRecord, RunError>, RunRecord, Vec<LinkEvent>) {
    let folder = tempfile::tempdir().unwrap();
    let lockstep = matches!(failure, InjectedFailure::PanicOnExchange | InjectedFailure::LostOnExchange);
    let mut scenario = load_scenario(FIG13);
    scenario.trials.count = 1;
    let clock = if lockstep { LOCKSTEP } else { REAL_TIME };
    let log = EventLog::default();
    let connect = || FailingLink { inner: new_link(clock), failure, samples: 0, failed: false, log: Arc::clone(&log) };
    let out = folder.path().join("run");
    let result = run_with_link(&plan(vec![scenario], clock), &out, connect);
    let record = RunRecord::read(&out).unwrap();
    let events = log.lock().unwrap().clone();
    (result, record, events)
}

#[track_caller]
fn assert_ends_at_zero_drive(events: &[LinkEvent]) {
    let failure = events.iter().position(|event| *event == LinkEvent::Failure).expect("a failure");
    let is_driven = |event: &LinkEvent| matches!(event, LinkEvent::Command { drive_vpp } if *drive_vpp > 100.0);
    assert!(events[..failure].iter().any(is_driven), "the plate was driven before");
    let after = &events[failure + 1..];
    assert_eq!(after.first(), Some(&LinkEvent::Safe { drive_vpp: 0.0, state: ControllerState::Safe }));
    assert!(after.iter().all(|event| matches!(event, LinkEvent::Safe { drive_vpp: 0.0, .. })), "{after:?}");
}

#[test]
fn a_panic_in_the_loop_leaves_the_plate_at_0_v() {
    for failure in [InjectedFailure::PanicOnSend, InjectedFailure::PanicOnReceive, InjectedFailure::PanicOnExchange] {
        let (result, record, events) = run_with_failure(failure);
        let error = result.expect_err("a panic is an error");
        assert!(
            matches!(&error, RunError::Internal(why) if why.contains("a planted panic of the link")),
            "{failure:?}: {error}"
        );
        assert_ends_at_zero_drive(&events);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), false), "{failure:?}");
    }
}

#[test]
fn an_error_of_the_line_leaves_the_plate_at_0_v() {
    for failure in [InjectedFailure::LostOnSend, InjectedFailure::LostOnReceive, InjectedFailure::LostOnExchange] {
        let (result, record, events) = run_with_failure(failure);
        let trial = &result.unwrap().scenarios[0].trials[0];
        assert!(trial.telemetry.ended.as_ref().is_some_and(|why| why.contains("on purpose")), "{failure:?}");
        assert_ends_at_zero_drive(&events);
        assert_eq!((record.safe_confirmed, record.complete), (Some(true), true), "{failure:?}");
    }
}

#[test]
fn a_lost_controller_has_no_confirmation_in_the_record() {
    let (result, record, events) = run_with_failure(InjectedFailure::LostPermanently);
    assert!(result.is_ok_and(|record| record.has_lost_controller()));
    assert_eq!(record.safe_confirmed, Some(false));
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    assert!(!timing.safe_confirmed);
    assert!(!events.iter().any(|event| matches!(event, LinkEvent::Safe { .. })));
}

#[test]
fn a_link_that_always_panics_ends_the_run() {
    let (result, record, _) = run_with_failure(InjectedFailure::PanicPermanently);
    assert!(matches!(result, Err(RunError::Internal(_))));
    assert_eq!((record.safe_confirmed, record.complete), (Some(false), false));
}
