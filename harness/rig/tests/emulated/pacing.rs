//! Tests the control paced by the board's timer.

use super::{CONFIGURE, sample};
use platebench_rig::{EmulatedLink, Link, Session, WallClockLink};
use platebench_wire::{Configure, ControllerState, Message, Packet, PacketReader, StateCause, Tick};
use std::time::{Duration, Instant};

const PACED: Configure = Configure { paced_by_target: true, ..CONFIGURE };
const STEP: Duration = Duration::from_micros(50);

fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).map(Result::unwrap).collect()
}

fn send_message(board: &mut EmulatedLink, now: Duration, sequence: u8, message: Message) -> Vec<u8> {
    let mut answer = Vec::new();
    board.exchange(now, Packet { sequence, message }.encode().as_bytes(), &mut answer).unwrap();
    answer
}

#[test]
fn sends_ticks_without_drift() {
    let mut board = EmulatedLink::built_in().unwrap();
    // The period is not a multiple of the 1 ms of the board's system timer.
    let configure = Configure { period_us: 730, ..PACED };
    send_message(&mut board, Duration::ZERO, 1, Message::Configure(configure));
    let mut received = Vec::new();
    for step in 1..4_000 {
        board.advance_to(step * STEP, &mut received).unwrap();
    }
    let ticks: Vec<_> = packets(&received)
        .into_iter()
        .map(|packet| match packet.message {
            Message::Tick(Tick { target_time_us }) => (packet.sequence, target_time_us),
            other => panic!("{other:?}"),
        })
        .collect();
    // The ticks fill 200 ms minus the time of the configuration.
    assert_eq!(ticks.len(), 272);
    let (_, first_us) = ticks[0];
    for (index, (sequence, at_us)) in (0..).zip(ticks) {
        assert_eq!(sequence, (index + 1) as u8);
        // The timer is exact to 1 µs; reading it takes up to 1 µs.
        assert!((first_us + index * 730).abs_diff(at_us) <= 1, "tick {index} at {at_us}");
    }
}

#[test]
fn controls_with_samples_on_ticks_until_they_end() {
    let mut board = EmulatedLink::built_in().unwrap();
    send_message(&mut board, Duration::ZERO, 1, Message::Configure(PACED));
    let (mut received, mut now, mut sequence) = (Vec::new(), Duration::ZERO, 1);
    while sequence < 40 {
        now += STEP;
        board.advance_to(now, &mut received).unwrap();
        if packets(&received).iter().any(|packet| matches!(packet.message, Message::Tick(_))) {
            received.clear();
            sequence += 1;
            let answer = packets(&send_message(&mut board, now, sequence, Message::Sample(sample(2.0, 1.9))));
            let running = |packet: &Packet| {
                packet.sequence == sequence
                    && matches!(packet.message, Message::Command(command) if command.state == ControllerState::Running)
            };
            assert!(answer.iter().any(running), "{answer:?}");
        }
    }
    received.clear();
    for _ in 0..200 {
        now += STEP;
        board.advance_to(now, &mut received).unwrap();
    }
    let packets = packets(&received);
    let fault = packets.iter().position(
        |packet| matches!(packet.message, Message::Command(command) if command.cause == StateCause::SampleTimeout),
    );
    assert_eq!(fault, Some(packets.len() - 1), "no tick after the fault: {packets:?}");
    // The watchdog acts five periods after the last sample, whose exchange takes up to one period.
    assert!((4..=5).contains(&(packets.len() - 1)), "{packets:?}");
}

#[test]
fn answers_the_boards_ticks_in_real_time() {
    let mut session = Session::open(WallClockLink::new(EmulatedLink::built_in().unwrap())).unwrap();
    assert!(session.supports_real_time());
    session.start_trial(&Configure { period_us: 5_000, ..PACED }).unwrap();
    let (mut ticks, mut last) = (0, None);
    while ticks < 10 {
        let received = session.receive(Instant::now() + Duration::from_secs(5)).unwrap().unwrap();
        assert!(last.is_none_or(|last| received.received_at >= last));
        last = Some(received.received_at);
        match received.message {
            Message::Tick(_) => {
                ticks += 1;
                session.send(Message::Sample(sample(2.0, 1.9))).unwrap();
            }
            Message::Command(command) => assert_eq!(command.state, ControllerState::Running),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(session.rejected_frames(), 0);
    assert!(session.request_safe_state());
}
