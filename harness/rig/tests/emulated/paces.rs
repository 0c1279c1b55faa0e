//! The board's own timer as the pace of the control.

use super::{CONFIGURE, sample};
use platebench_rig::{Emulated, Link, Paced, Session};
use platebench_wire::{Configure, FrameReader, Message, Packet, State, StateCause, Tick};
use std::time::{Duration, Instant};

const PACED: Configure = Configure { paced_by_target: true, ..CONFIGURE };
const STEP: Duration = Duration::from_micros(50);

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut reader = FrameReader::new();
    bytes.iter().filter_map(|&byte| reader.push(byte).map(|body| Packet::decode(body.unwrap()).unwrap())).collect()
}

fn say(board: &mut Emulated, now: Duration, sequence: u8, message: Message) -> Vec<u8> {
    let mut answer = Vec::new();
    board.exchange(now, Packet { sequence, message }.encode().as_bytes(), &mut answer).unwrap();
    answer
}

#[test]
fn ticks_come_a_period_apart_on_the_board_s_clock_and_do_not_drift() {
    let mut board = Emulated::built_in().unwrap();
    // Not a multiple of the millisecond at which the board looks at the time anyway.
    let configure = Configure { period_us: 730, ..PACED };
    say(&mut board, Duration::ZERO, 1, Message::Configure(configure));
    let mut said = Vec::new();
    for step in 1..4_000 {
        board.pass(step * STEP, &mut said).unwrap();
    }
    let ticks: Vec<_> = packets(&said)
        .into_iter()
        .map(|packet| match packet.message {
            Message::Tick(Tick { target_time_us }) => (packet.sequence, target_time_us),
            other => panic!("{other:?}"),
        })
        .collect();
    // 200 ms, less what the configuration took.
    assert_eq!(ticks.len(), 272);
    let (_, first_us) = ticks[0];
    for (index, (sequence, at_us)) in (0..).zip(ticks) {
        assert_eq!(sequence, (index + 1) as u8);
        // The alarm rings on the microsecond; looking at the time takes the processor no more than one.
        assert!((first_us + index * 730).abs_diff(at_us) <= 1, "tick {index} at {at_us}");
    }
}

#[test]
fn samples_that_answer_ticks_are_controlled_with_and_their_end_is_noticed() {
    let mut board = Emulated::built_in().unwrap();
    say(&mut board, Duration::ZERO, 1, Message::Configure(PACED));
    let (mut said, mut now, mut sequence) = (Vec::new(), Duration::ZERO, 1);
    while sequence < 40 {
        now += STEP;
        board.pass(now, &mut said).unwrap();
        if packets(&said).iter().any(|packet| matches!(packet.message, Message::Tick(_))) {
            said.clear();
            sequence += 1;
            let answer = packets(&say(&mut board, now, sequence, Message::Sample(sample(2.0, 1.9))));
            let running = |packet: &Packet| {
                packet.sequence == sequence
                    && matches!(packet.message, Message::Command(command) if command.state == State::Running)
            };
            assert!(answer.iter().any(running), "{answer:?}");
        }
    }
    said.clear();
    for _ in 0..200 {
        now += STEP;
        board.pass(now, &mut said).unwrap();
    }
    let told = packets(&said);
    let fault = told.iter().position(
        |packet| matches!(packet.message, Message::Command(command) if command.cause == StateCause::SampleTimeout),
    );
    assert_eq!(fault, Some(told.len() - 1), "no tick after the fault: {told:?}");
    // One period of computing and wire is the sample's own.
    assert!((4..=5).contains(&(told.len() - 1)), "{told:?}");
}

#[test]
fn in_real_time_the_board_is_heard_and_answered() {
    let mut session = Session::open(Paced::new(Emulated::built_in().unwrap())).unwrap();
    assert!(session.is_live());
    session.begin(&Configure { period_us: 5_000, ..PACED }).unwrap();
    let (mut ticks, mut last) = (0, None);
    while ticks < 10 {
        let heard = session.listen(Instant::now() + Duration::from_secs(5)).unwrap().unwrap();
        assert!(last.is_none_or(|last| heard.at >= last));
        last = Some(heard.at);
        match heard.message {
            Message::Tick(_) => {
                ticks += 1;
                session.post(Message::Sample(sample(2.0, 1.9))).unwrap();
            }
            Message::Command(command) => assert_eq!(command.state, State::Running),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(session.refused(), 0);
    assert!(session.safe());
}
