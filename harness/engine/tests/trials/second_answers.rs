//! Checks that doubled answers and an invented confirmation of 0 V have reasons of their own.

use crate::fixtures::{FIG13, LOCKSTEP, packets, plan};
use platebench_engine::{RunHooks, run};
use platebench_model::record::{RunFolder, RunRecord, Verdict, ViolationKind};
use platebench_rig::{HostedLink, Link, LinkError};
use platebench_test_kit::load_scenario;
use platebench_wire::{Command, ControllerState, Message, Packet};
use std::time::Duration;

/// `more` returns what the controller sends besides its answer.
struct TalkingLink {
    inner: HostedLink,
    more: fn(&Packet) -> Option<Packet>,
}

impl Link for TalkingLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let from = answer.len();
        let delay = self.inner.exchange(now, bytes, answer)?;
        for packet in packets(&answer[from..]) {
            if let Some(packet) = (self.more)(&packet) {
                answer.extend_from_slice(packet.encode().as_bytes());
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
}

fn run_with(more: fn(&Packet) -> Option<Packet>) -> RunRecord {
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let connect = || Ok(Box::new(TalkingLink { inner: HostedLink::new(), more }) as Box<dyn Link>);
    run(&plan(vec![load_scenario(FIG13)], LOCKSTEP), &run_folder, &connect, RunHooks::default()).unwrap()
}

fn violations(record: &RunRecord) -> Vec<ViolationKind> {
    let mut kinds: Vec<_> = record.scenarios[0].trials[0].telemetry.violations.iter().map(|one| one.kind).collect();
    kinds.sort_unstable();
    kinds
}

#[test]
fn doubled_answers_fail_as_second_replies() {
    let record = run_with(|packet| matches!(packet.message, Message::Command(_)).then_some(*packet));
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::SecondReply]));
}

#[test]
fn a_doubled_confirmation_of_0_v_fails_as_a_second_reply() {
    let record = run_with(|packet| {
        let is_safe = matches!(packet.message, Message::Command(Command { state: ControllerState::Safe, .. }));
        is_safe.then_some(*packet)
    });
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::SecondReply]));
}

#[test]
fn an_invented_confirmation_of_0_v_fails_with_its_own_reason() {
    let record = run_with(|packet| match packet.message {
        Message::Command(command) if command.state == ControllerState::Running => {
            let message = Message::Command(Command { state: ControllerState::Safe, drive_vpp: 0.0, ..command });
            Some(Packet { message, ..*packet })
        }
        _ => None,
    });
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::UnrequestedSafe]));
}
