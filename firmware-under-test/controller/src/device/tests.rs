//! Tests the device through encoded frames.

use super::*;
use crate::law::example::CONFIGURE;
use platebench_wire::{ControllerState, Sample, Setpoint, StateCause, Tick};
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

fn receive(device: &mut Device, now_us: u32, bytes: &[u8]) -> Vec<Packet> {
    let mut sent = Vec::new();
    device.receive(bytes, now_us, |frame| sent.extend_from_slice(frame));
    packets(&sent)
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    platebench_wire::PacketReader::new().packets(bytes).map(Result::unwrap).collect()
}

fn frame(sequence: u8, message: Message) -> Vec<u8> {
    Packet { sequence, message }.encode().as_bytes().to_vec()
}

fn sample(sequence: u8, wd_um: f32) -> Vec<u8> {
    frame(sequence, Message::Sample(Sample { time_us: 0, setpoint_um: 2.0, wd_um, wq_um: 0.0 }))
}

fn configured_device() -> Device {
    let mut device = Device::new(IDENTITY);
    assert_eq!(receive(&mut device, 0, &frame(1, Message::Configure(CONFIGURE))).len(), 1);
    device
}

#[test]
fn answers_repeat_the_sequence_number() {
    let mut device = Device::new(IDENTITY);
    let answers = receive(&mut device, 0, &frame(77, Message::Hello));
    assert_eq!(answers, [Packet { sequence: 77, message: Message::Identity(IDENTITY) }]);
    let answers = receive(&mut device, 0, &frame(78, Message::Safe));
    assert!(matches!(
        answers[..],
        [Packet { sequence: 78, message: Message::Command(Command { state: ControllerState::Safe, .. }) }]
    ));
}

#[test]
fn a_repeated_sample_repeats_the_last_command() {
    let mut device = configured_device();
    let first = receive(&mut device, 0, &sample(2, 0.0));
    let doubled = receive(&mut device, 0, &sample(2, 0.0));
    assert_eq!(first, doubled);
    // If the law had stepped twice, its integral and the next drive would be larger.
    let mut undisturbed = configured_device();
    receive(&mut undisturbed, 0, &sample(2, 0.0));
    assert_eq!(receive(&mut device, 1_000, &sample(3, 1.0)), receive(&mut undisturbed, 1_000, &sample(3, 1.0)));
}

#[test]
fn a_frame_in_pieces_is_answered_when_complete() {
    let mut device = configured_device();
    let bytes = sample(2, 0.0);
    let (last, head) = bytes.split_last().unwrap();
    assert_eq!(receive(&mut device, 0, head), []);
    assert_eq!(receive(&mut device, 0, &[*last]).len(), 1);
}

#[test]
fn a_corrupted_frame_is_never_acted_on() {
    let mut device = configured_device();
    let before = receive(&mut device, 0, &sample(2, 1.9));
    let mut bytes = sample(3, 0.0);
    bytes[10] ^= 0x20;
    assert_eq!(receive(&mut device, 1_000, &bytes), []);
    let Message::Command(command) = before[0].message else { panic!("a sample is answered by a command") };
    assert_eq!(device.output().drive_vpp, command.drive_vpp);
}

#[test]
fn noise_and_silence_are_reported_unsolicited() {
    let mut device = configured_device();
    receive(&mut device, 0, &sample(9, 1.0));
    let packets_sent = receive(&mut device, 500, &[1, 2, 3, 0].repeat(5));
    let [Packet { sequence: 9, message: Message::Command(command) }] = packets_sent[..] else {
        panic!("{packets_sent:?}")
    };
    assert_eq!((command.state, command.cause), (ControllerState::Fault, StateCause::LineNoise));

    let mut device = configured_device();
    receive(&mut device, 0, &sample(9, 1.0));
    let mut sent = Vec::new();
    for now_us in (0..20_000).step_by(500) {
        device.tick(now_us, |frame| sent.extend_from_slice(frame));
    }
    let packets_sent = packets(&sent);
    let [Packet { message: Message::Command(command), .. }] = packets_sent[..] else { panic!("{packets_sent:?}") };
    assert_eq!((command.target_time_us, command.cause), (5_000, StateCause::SampleTimeout));
}

fn target_paced_device(identity: Identity, period_us: u32, now_us: u32) -> (Device, Vec<Packet>) {
    let mut device = Device::new(identity);
    let configure = Configure { paced_by_target: true, period_us, ..CONFIGURE };
    let answer = receive(&mut device, now_us, &frame(1, Message::Configure(configure)));
    (device, answer)
}

fn ticks(device: &mut Device, now_us: u32) -> Vec<Packet> {
    let mut sent = Vec::new();
    device.tick(now_us, |frame| sent.extend_from_slice(frame));
    packets(&sent)
}

fn tick(sequence: u8, target_time_us: u32) -> Packet {
    Packet { sequence, message: Message::Tick(Tick { target_time_us }) }
}

#[test]
fn a_pacing_target_sends_a_tick_per_period() {
    let start = u32::MAX - 1_499;
    let (mut device, answer) = target_paced_device(IDENTITY, 1_000, start);
    assert!(matches!(answer[..], [Packet { message: Message::Configured(Configured { outcome: Ok(_) }), .. }]));
    let at = |us: u32| start.wrapping_add(us);
    assert_eq!(ticks(&mut device, at(999)), []);
    assert_eq!(device.next_tick_us(), Some(at(1_000)));
    assert_eq!(ticks(&mut device, at(1_000)), [tick(1, at(1_000))]);
    assert_eq!(ticks(&mut device, at(1_000)), []);
    // This call is 900 µs late, but the next period begins on time.
    assert_eq!(ticks(&mut device, at(2_900)), [tick(2, at(2_900))]);
    assert_eq!(ticks(&mut device, at(3_000)), [tick(3, at(3_000))]);
    assert_eq!(ticks(&mut device, at(6_001)), [tick(4, at(6_001))]);
    assert_eq!(ticks(&mut device, at(6_999)), []);
    assert_eq!(ticks(&mut device, at(7_000)), [tick(5, at(7_000))]);
}

#[test]
fn ticks_do_not_drift() {
    let (mut device, _) = target_paced_device(IDENTITY, 1_000, 0);
    let mut ticks_sent = 0_u32;
    for now_us in (0..20_000_000).step_by(333) {
        if now_us % 999 == 0 {
            receive(&mut device, now_us, &sample((now_us / 999) as u8, 1.0));
        }
        for packet in ticks(&mut device, now_us) {
            ticks_sent += 1;
            let Message::Tick(Tick { target_time_us }) = packet.message else { panic!("{packet:?}") };
            assert!(target_time_us - ticks_sent * 1_000 < 333, "tick {ticks_sent} at {target_time_us}");
        }
    }
    assert_eq!(ticks_sent, 19_999);
}

#[test]
fn ticks_end_with_the_trial() {
    let running = || {
        let (mut device, _) = target_paced_device(IDENTITY, 1_000, 0);
        assert_eq!(ticks(&mut device, 1_000), [tick(1, 1_000)]);
        receive(&mut device, 1_100, &sample(2, 1.0));
        assert_eq!(ticks(&mut device, 2_000), [tick(2, 2_000)]);
        device
    };
    let mut safe = running();
    receive(&mut safe, 2_500, &frame(3, Message::Safe));
    assert_eq!(ticks(&mut safe, 3_000), []);
    assert_eq!(safe.next_tick_us(), None);

    let mut again = running();
    receive(&mut again, 2_500, &frame(3, Message::Configure(CONFIGURE)));
    assert_eq!(ticks(&mut again, 3_000), []);

    // Five periods after the sample at 1.1 ms the device sends 0 V, once.
    let mut deserted = running();
    assert_eq!(ticks(&mut deserted, 6_099).len(), 1);
    let packets_sent = ticks(&mut deserted, 6_100);
    assert!(
        matches!(
            packets_sent[..],
            [Packet { message: Message::Command(Command { state: ControllerState::Fault, .. }), .. }]
        ),
        "{packets_sent:?}"
    );
    assert_eq!(ticks(&mut deserted, 7_000), []);

    let (mut alone, _) = target_paced_device(IDENTITY, 1_000, 0);
    assert_eq!(ticks(&mut alone, 999_999).len(), 1);
    assert_eq!(ticks(&mut alone, 1_000_000), []);
    assert_eq!(ticks(&mut alone, 1_001_000), []);
}

#[test]
fn target_pacing_needs_the_capability() {
    let (mut device, answer) = target_paced_device(Identity { capabilities: 0, ..IDENTITY }, 1_000, 0);
    let refused = Message::Configured(Configured { outcome: Err(Rejection::Value) });
    assert_eq!(answer, [Packet { sequence: 1, message: refused }]);
    assert_eq!(ticks(&mut device, 1_000), []);
    receive(&mut device, 1_000, &sample(2, 0.0));
    assert_eq!((device.output().state, device.output().drive_vpp), (ControllerState::Idle, 0.0));

    let mut device = Device::new(IDENTITY);
    let bad = Configure { paced_by_target: true, time_constant_s: 0.0, ..CONFIGURE };
    receive(&mut device, 0, &frame(1, Message::Configure(bad)));
    assert_eq!(device.next_tick_us(), None);
}

#[test]
fn without_its_own_plate_setpoints_are_ignored() {
    let mut device = Device::new(IDENTITY);
    let own = Configure { drives_own_plate: true, ..CONFIGURE };
    let refused = Message::Configured(Configured { outcome: Err(Rejection::Value) });
    assert_eq!(receive(&mut device, 0, &frame(1, Message::Configure(own))), [Packet { sequence: 1, message: refused }]);
    let mut device = configured_device();
    assert_eq!(receive(&mut device, 0, &frame(2, Message::Setpoint(Setpoint { setpoint_um: 2.0 }))), []);
    assert_eq!(device.output().drive_vpp, 0.0);
}

#[test]
fn echoed_frames_are_ignored() {
    let mut device = configured_device();
    let commands = receive(&mut device, 0, &sample(2, 0.0));
    assert_eq!(receive(&mut device, 0, commands[0].encode().as_bytes()), []);
}

proptest! {
    #[test]
    fn garbage_never_makes_an_idle_device_drive(bytes in proptest::collection::vec(any::<u8>(), 0..4_000)) {
        let mut device = Device::new(IDENTITY);
        receive(&mut device, 0, &bytes);
        prop_assert_eq!(device.output().drive_vpp, 0.0);
    }
}
