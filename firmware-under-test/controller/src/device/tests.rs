//! The device as its line sees it.

use super::*;
use crate::law::example::CONFIGURE;
use platebench_wire::{FrameReader, Sample, State, StateCause, capabilities};
use proptest::prelude::*;
use std::vec::Vec;

const IDENTITY: Identity = Identity {
    version: [0, 1, 0],
    capabilities: capabilities::TARGET_PACED,
    laws: 0b111,
    build: [0; 8],
    chip: 0,
    unique: [0; 12],
    name: *b"device under tes",
};

fn say(device: &mut Device, now_us: u32, bytes: &[u8]) -> Vec<Packet> {
    let mut sent = Vec::new();
    device.receive(bytes, now_us, |frame| sent.extend_from_slice(frame));
    packets(&sent)
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut reader = FrameReader::new();
    bytes.iter().filter_map(|&byte| reader.push(byte).map(|body| Packet::decode(body.unwrap()).unwrap())).collect()
}

fn frame(sequence: u8, message: Message) -> Vec<u8> {
    Packet { sequence, message }.encode().as_bytes().to_vec()
}

fn sample(sequence: u8, wd_um: f32) -> Vec<u8> {
    frame(sequence, Message::Sample(Sample { time_us: 0, setpoint_um: 2.0, wd_um, wq_um: 0.0 }))
}

fn configured() -> Device {
    let mut device = Device::new(IDENTITY);
    assert_eq!(say(&mut device, 0, &frame(1, Message::Configure(CONFIGURE))).len(), 1);
    device
}

#[test]
fn every_question_is_answered_under_its_number() {
    let mut device = Device::new(IDENTITY);
    let answers = say(&mut device, 0, &frame(77, Message::Hello));
    assert_eq!(answers, [Packet { sequence: 77, message: Message::Identity(IDENTITY) }]);
    let answers = say(&mut device, 0, &frame(78, Message::Safe));
    assert!(matches!(
        answers[..],
        [Packet { sequence: 78, message: Message::Command(Command { state: State::Safe, .. }) }]
    ));
}

#[test]
fn a_doubled_sample_is_answered_again_and_not_controlled_with_again() {
    let mut device = configured();
    let first = say(&mut device, 0, &sample(2, 0.0));
    let doubled = say(&mut device, 0, &sample(2, 0.0));
    assert_eq!(first, doubled);
    // Had the law stepped twice, its integral would have grown and the next drive with it.
    let mut undisturbed = configured();
    say(&mut undisturbed, 0, &sample(2, 0.0));
    assert_eq!(say(&mut device, 1_000, &sample(3, 1.0)), say(&mut undisturbed, 1_000, &sample(3, 1.0)));
}

#[test]
fn a_frame_in_pieces_is_answered_once_it_is_whole() {
    let mut device = configured();
    let bytes = sample(2, 0.0);
    let (last, head) = bytes.split_last().unwrap();
    assert_eq!(say(&mut device, 0, head), []);
    assert_eq!(say(&mut device, 0, &[*last]).len(), 1);
}

#[test]
fn a_corrupted_frame_is_never_acted_on() {
    let mut device = configured();
    let before = say(&mut device, 0, &sample(2, 1.9));
    let mut bytes = sample(3, 0.0);
    bytes[10] ^= 0x20;
    assert_eq!(say(&mut device, 1_000, &bytes), []);
    let Message::Command(command) = before[0].message else { panic!("a sample is answered by a command") };
    assert_eq!(device.output().drive_vpp, command.drive_vpp);
}

#[test]
fn a_storm_and_a_silence_are_told_without_being_asked() {
    let mut device = configured();
    say(&mut device, 0, &sample(9, 1.0));
    let told = say(&mut device, 500, &[1, 2, 3, 0].repeat(5));
    let [Packet { sequence: 9, message: Message::Command(command) }] = told[..] else { panic!("{told:?}") };
    assert_eq!((command.state, command.cause), (State::Fault, StateCause::LineNoise));

    let mut device = configured();
    say(&mut device, 0, &sample(9, 1.0));
    let mut sent = Vec::new();
    for now_us in (0..20_000).step_by(500) {
        device.tick(now_us, |frame| sent.extend_from_slice(frame));
    }
    let told = packets(&sent);
    let [Packet { message: Message::Command(command), .. }] = told[..] else { panic!("{told:?}") };
    assert_eq!((command.target_time_us, command.cause), (5_000, StateCause::SampleTimeout));
}

#[test]
fn an_echoing_line_is_no_reason_to_act() {
    let mut device = configured();
    let commands = say(&mut device, 0, &sample(2, 0.0));
    assert_eq!(say(&mut device, 0, commands[0].encode().as_bytes()), []);
}

proptest! {
    #[test]
    fn garbage_never_makes_an_idle_device_drive(bytes in proptest::collection::vec(any::<u8>(), 0..4_000)) {
        let mut device = Device::new(IDENTITY);
        say(&mut device, 0, &bytes);
        prop_assert_eq!(device.output().drive_vpp, 0.0);
    }
}
