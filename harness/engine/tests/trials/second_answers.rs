//! Checks that doubled answers, an invented confirmation of 0 V and damaged frames have reasons of
//! their own.

use crate::fixtures::{FIG13, LOCKSTEP, plan, run_with_link};
use platebench_model::record::{RunRecord, Verdict, ViolationKind};
use platebench_rig::{HostedLink, Link, LinkKind, Session};
use platebench_test_kit::{IDENTITY, ScriptedLink, load_scenario, packets};
use platebench_wire::{Command, Configured, ControllerState, Gains, Message, Packet, Tick};
use rstest::rstest;

const NO_GAINS: Gains = Gains { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };

fn frame(packet: &Packet) -> Vec<u8> {
    packet.encode().as_bytes().to_vec()
}

/// `more` returns the frame that the controller sends besides its answer.
fn run_with(more: fn(&Packet) -> Option<Vec<u8>>) -> RunRecord {
    run_on(LinkKind::Simulated, more)
}

fn run_on(kind: LinkKind, more: fn(&Packet) -> Option<Vec<u8>>) -> RunRecord {
    let link = ScriptedLink::new(move |controller, now, bytes, answer| {
        let from = answer.len();
        let delay = controller.exchange(now, bytes, answer)?;
        for packet in packets(&answer[from..]) {
            answer.extend(more(&packet).into_iter().flatten());
        }
        Ok(delay)
    });
    let (link, folder) = (link.of_kind(kind), tempfile::tempdir().unwrap());
    run_with_link(&plan(vec![load_scenario(FIG13)], LOCKSTEP), &folder.path().join("run"), || link.clone()).unwrap()
}

fn violations(record: &RunRecord) -> Vec<ViolationKind> {
    let mut kinds: Vec<_> = record.scenarios[0].trials[0].telemetry.violations.iter().map(|one| one.kind).collect();
    kinds.sort_unstable();
    kinds
}

#[test]
fn doubled_answers_fail_as_second_replies() {
    let record = run_with(|packet| matches!(packet.message, Message::Command(_)).then(|| frame(packet)));
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::SecondReply]));
}

#[test]
fn a_doubled_confirmation_of_0_v_fails_as_a_second_reply() {
    let record = run_with(|packet| {
        let is_safe = matches!(packet.message, Message::Command(Command { state: ControllerState::Safe, .. }));
        is_safe.then(|| frame(packet))
    });
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::SecondReply]));
}

/// A slow bench reads both messages at once.
#[test]
fn a_drive_in_one_read_with_the_confirmation_is_a_drive_after_0_v() {
    let record = run_with(|packet| {
        let Message::Command(command) = packet.message else { return None };
        let drive = Command { state: ControllerState::Running, drive_vpp: 900.0, ..command };
        let is_safe = command.state == ControllerState::Safe;
        is_safe.then(|| frame(&Packet { sequence: packet.sequence, message: Message::Command(drive) }))
    });
    assert_eq!(record.verdict, Verdict::Fail);
    assert!(violations(&record).contains(&ViolationKind::DriveAfterSafe), "{:?}", violations(&record));
    assert_eq!((record.drive_after_safe, record.safe_confirmed), (true, Some(false)));
}

#[test]
fn an_invented_confirmation_of_0_v_fails_with_its_own_reason() {
    let record = run_with(|packet| match packet.message {
        Message::Command(command) if command.state == ControllerState::Running => {
            let message = Message::Command(Command { state: ControllerState::Safe, drive_vpp: 0.0, ..command });
            Some(frame(&Packet { message, ..*packet }))
        }
        _ => None,
    });
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::UnrequestedSafe]));
}

/// Sends a second answer with a wrong last byte of the CRC.
fn damaged(packet: &Packet) -> Option<Vec<u8>> {
    let mut bytes = frame(packet);
    let last = bytes.iter_mut().nth_back(1)?;
    *last = if *last == 1 { 2 } else { 1 };
    matches!(packet.message, Message::Command(_)).then_some(bytes)
}

#[rstest]
#[case::simulated(LinkKind::Simulated, true)]
#[case::program(LinkKind::Lossless, true)]
#[case::serial_line(LinkKind::Lossy, false)]
fn a_damaged_frame_fails_unless_the_line_may_damage_it(#[case] kind: LinkKind, #[case] fails: bool) {
    let record = run_on(kind, damaged);
    let expected = if fails { vec![ViolationKind::RejectedFrame] } else { Vec::new() };
    assert_eq!((record.verdict == Verdict::Fail, violations(&record)), (fails, expected));
}

/// Answers of the controller to another client, which a server sends to this bench as well.
fn identity(packet: &Packet) -> Option<Vec<u8>> {
    let identity = Session::open(HostedLink::new()).unwrap().identity().to_owned();
    is_running(packet).then(|| frame(&Packet { sequence: 0, message: Message::Identity(identity) }))
}

fn configured(packet: &Packet) -> Option<Vec<u8>> {
    let gains = Gains { amplitude_kp: 1.0, amplitude_ki: 1.0, frequency_kp: 1.0, frequency_ki: 1.0 };
    let message = Message::Configured(Configured { outcome: Ok(gains) });
    is_running(packet).then(|| frame(&Packet { message, ..*packet }))
}

fn is_running(packet: &Packet) -> bool {
    matches!(packet.message, Message::Command(Command { state: ControllerState::Running, .. }))
}

#[rstest]
#[case::identity(identity)]
#[case::configured(configured)]
fn another_client_of_a_server_decides_nothing(#[case] answer: fn(&Packet) -> Option<Vec<u8>>) {
    let record = run_on(LinkKind::Network, answer);
    assert_eq!((record.verdict, violations(&record)), (Verdict::Inconclusive, Vec::new()));
    let trial = &record.scenarios[0].trials[0].telemetry;
    assert!(trial.ended.as_ref().unwrap().starts_with("another client uses the line"), "{:?}", trial.ended);
    assert!(!trial.ended_by_controller);
    // No second client can use another rig.
    for kind in [LinkKind::Simulated, LinkKind::Lossless, LinkKind::Lossy] {
        assert_eq!(run_on(kind, answer).scenarios[0].trials[0].telemetry.ended, None, "{kind:?}");
    }
}

/// A faulty controller must not look like another client.
#[test]
fn doubled_answers_fail_behind_a_server_too() {
    let doubled = |packet: &Packet| matches!(packet.message, Message::Command(_)).then(|| frame(packet));
    let record = run_on(LinkKind::Network, doubled);
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::SecondReply]));
}

fn after_the_50th_command(packet: &Packet, message: Message) -> Option<Vec<u8>> {
    let is_late = matches!(packet.message, Message::Command(_)) && packet.sequence == 50;
    is_late.then(|| frame(&Packet { sequence: packet.sequence, message }))
}

fn late_identity(packet: &Packet) -> Option<Vec<u8>> {
    after_the_50th_command(packet, Message::Identity(IDENTITY))
}

fn late_configured(packet: &Packet) -> Option<Vec<u8>> {
    after_the_50th_command(packet, Message::Configured(Configured { outcome: Ok(NO_GAINS) }))
}

fn late_tick(packet: &Packet) -> Option<Vec<u8>> {
    after_the_50th_command(packet, Message::Tick(Tick { target_time_us: 1 }))
}

fn late_echo(packet: &Packet) -> Option<Vec<u8>> {
    after_the_50th_command(packet, Message::Safe)
}

fn late_idle(packet: &Packet) -> Option<Vec<u8>> {
    let Message::Command(command) = packet.message else { return None };
    let idle = Command { state: ControllerState::Idle, drive_vpp: 0.0, flags: 0, ..command };
    let sequence = packet.sequence.wrapping_add(100);
    (packet.sequence == 50).then(|| frame(&Packet { sequence, message: Message::Command(idle) }))
}

/// No script of the protocol check is part of the scenario.
#[rstest]
#[case::identity(late_identity)]
#[case::configured(late_configured)]
#[case::tick(late_tick)]
#[case::echo_of_a_request(late_echo)]
#[case::idle_command(late_idle)]
fn a_message_that_no_request_caused_fails(#[case] more: fn(&Packet) -> Option<Vec<u8>>) {
    let record = run_with(more);
    assert_eq!((record.verdict, violations(&record)), (Verdict::Fail, vec![ViolationKind::UnrequestedMessage]));
    // Noise on a line may make such a message.
    assert_eq!(violations(&run_on(LinkKind::Lossy, more)), []);
}
