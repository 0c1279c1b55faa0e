use crate::fixtures::{FIG13, LOCKSTEP, REAL_TIME, new_link, plan, run_with_link};
use platebench_engine::{Clock, RunError};
use platebench_model::record::{Cause, RunRecord, Verdict};
use platebench_rig::{BoxedLink, Link, LinkError, RealTimeLine};
use platebench_test_kit::{load_scenario, packets};
use platebench_wire::Message;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

const SAMPLES_BEFORE_FAILURE: u32 = 20;

#[derive(Debug, Clone, Copy, PartialEq)]
enum BoardFailure {
    Restart,
    Unplugging,
}

struct FailingBoard {
    inner: BoxedLink,
    number: u8,
    failure: Option<BoardFailure>,
    samples: u32,
}

impl FailingBoard {
    fn count_and_fail(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples +=
            packets(bytes).iter().filter(|packet| matches!(packet.message, Message::Sample(_))).count() as u32;
        if self.samples > SAMPLES_BEFORE_FAILURE && self.failure == Some(BoardFailure::Unplugging) {
            return Err(LinkError::Disconnected("unplugged".to_owned()));
        }
        if self.samples > SAMPLES_BEFORE_FAILURE && self.failure.take() == Some(BoardFailure::Restart) {
            assert!(self.inner.restart()?, "the link cannot restart");
        }
        Ok(())
    }
}

impl Link for FailingBoard {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.count_and_fail(bytes)?;
        let mut received = Vec::new();
        let delay = self.inner.exchange(now, bytes, &mut received)?;
        for packet in &mut packets(&received) {
            if let Message::Identity(identity) = &mut packet.message {
                identity.unique[0] = self.number;
            }
            answer.extend(packet.encode().as_bytes());
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        self.inner.real_time_line().is_some().then_some(self as &mut dyn RealTimeLine)
    }
}

impl RealTimeLine for FailingBoard {
    fn now(&mut self) -> Instant {
        self.inner.real_time_line().unwrap().now()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.count_and_fail(bytes)?;
        self.inner.real_time_line().unwrap().send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.inner.real_time_line().unwrap().receive(until, bytes)
    }
}

fn run_on_boards(clock: Clock, failure: BoardFailure, numbers: [u8; 2]) -> (Result<RunRecord, RunError>, RunRecord) {
    let mut scenario = load_scenario(FIG13);
    (scenario.trials.count, scenario.trials.max_count) = (2, 2);
    let folder = tempfile::tempdir().unwrap();
    let connections = AtomicU8::new(0);
    let connect = || {
        let count = connections.fetch_add(1, Ordering::Relaxed);
        let number = numbers[usize::from(count.min(1))];
        FailingBoard { inner: new_link(clock), number, failure: (count == 0).then_some(failure), samples: 0 }
    };
    let out = folder.path().join("run");
    let result = run_with_link(&plan(vec![scenario], clock), &out, connect);
    (result, RunRecord::read(&out).unwrap())
}

#[test]
fn a_restart_within_a_trial_is_inconclusive() {
    for clock in [LOCKSTEP, REAL_TIME] {
        let (result, record) = run_on_boards(clock, BoardFailure::Restart, [1, 1]);
        assert!(result.is_ok(), "{clock:?}");
        let trials = &record.scenarios[0].trials;
        let ended: Vec<_> = trials.iter().map(|trial| trial.telemetry.ended.clone().unwrap_or_default()).collect();
        assert_eq!(ended, ["the controller was restarted in the middle of a trial", ""], "{clock:?}");
        assert_eq!(trials[0].cause, Some(Cause::Rig), "{clock:?}");
        assert_eq!((record.verdict, record.has_lost_controller()), (Verdict::Inconclusive, true), "{clock:?}");
    }
}

#[test]
fn only_the_same_board_may_continue_a_run() {
    let (result, record) = run_on_boards(LOCKSTEP, BoardFailure::Unplugging, [1, 1]);
    assert!(result.is_ok_and(|record| record.scenarios[0].trials.len() == 2 && record.has_lost_controller()));
    assert!(record.complete);
    let (result, record) = run_on_boards(LOCKSTEP, BoardFailure::Unplugging, [1, 2]);
    let error = result.unwrap_err();
    assert!(matches!(error, RunError::DifferentController { .. }), "{error}");
    let message = error.to_string();
    assert!(message.contains("number 020000") && message.contains("but was platebench-host"), "{message}");
    assert_eq!((record.complete, record.safe_confirmed), (false, Some(false)));
}
