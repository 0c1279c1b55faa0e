//! Checks every byte of every message, the round trip and the rejections.

use super::*;
use crate::frame::{FrameReader, MAX_BODY};
use crate::{ControllerState, Gains, LawId, Rejection, StateCause, capabilities, flags};
use proptest::prelude::*;
use std::vec::Vec;

const GAINS: Gains = Gains { amplitude_kp: 1.0, amplitude_ki: -2.0, frequency_kp: 0.5, frequency_ki: 4.0 };

const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    watchdog_timeout_ms: 0,
    period_us: 1000,
    loop_delay_us: 0,
    start_frequency_mhz: 32_307_600,
    gain_um_per_vpp: 0.5,
    time_constant_s: 0.25,
    response_time_s: 2.0,
    drive_limit_vpp: 900.0,
    frequency_range_hz: 200.0,
    frequency_slew_hz: 100.0,
    gains: Some(GAINS),
};

fn encoded_body(packet: &Packet) -> Vec<u8> {
    let mut reader = FrameReader::new();
    let frame = packet.encode();
    let mut bodies = frame
        .as_bytes()
        .iter()
        .filter_map(|&byte| reader.push(byte).map(|body| body.unwrap().to_vec()))
        .collect::<Vec<_>>();
    assert_eq!(bodies.len(), 1);
    bodies.remove(0)
}

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

#[track_caller]
fn assert_bytes(sequence: u8, message: Message, bytes: &str) {
    let packet = Packet { sequence, message };
    assert_eq!(encoded_body(&packet), hex(bytes));
    assert_eq!(Packet::decode(&hex(bytes)), Ok(packet));
}

#[test]
fn hello_and_safe_are_two_bytes() {
    assert_bytes(0, Message::Hello, "11 00");
    assert_bytes(255, Message::Safe, "17 ff");
}

#[test]
fn identity_is_fifty_bytes() {
    let identity = Identity {
        version: [1, 2, 3],
        capabilities: capabilities::TARGET_PACED,
        laws: 0b111,
        build: [0xa0, 0xa1, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7],
        chip: 0x1000_0413,
        unique: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12],
        name: *b"firmware\0\0\0\0\0\0\0\0",
    };
    assert_bytes(
        9,
        Message::Identity(identity),
        "12 09 01 02 03 01 07 00 00 00 a0 a1 a2 a3 a4 a5 a6 a7 13 04 00 10 01 02 03 04 05 06 07 08 09 0a 0b 0c \
         66 69 72 6d 77 61 72 65 00 00 00 00 00 00 00 00",
    );
    assert!(
        identity.has_capability(capabilities::TARGET_PACED) && !identity.has_capability(capabilities::COMPUTE_TIME)
    );
    assert!(Identity { capabilities: 0xfe, ..identity }.has_capability(capabilities::COMPUTE_TIME));
    assert!(identity.has_law(LawId::DqPiEuler));
    assert!(!Identity { laws: 0b011, ..identity }.has_law(LawId::DqPiEuler));
}

#[test]
fn configure_is_fifty_four_bytes() {
    let configure = CONFIGURE;
    let head =
        "01 01 00 00 e8 03 00 00 90 f9 ec 01 00 00 00 3f 00 00 80 3e 00 00 00 40 00 00 61 44 00 00 48 43 00 00 c8 42";
    let gains = "00 00 80 3f 00 00 00 c0 00 00 00 3f 00 00 80 40";
    assert_bytes(1, Message::Configure(configure), &std::format!("13 01 {head} {gains}"));
    let own_design = head.replacen("01 01", "01 00", 1);
    assert_bytes(
        1,
        Message::Configure(Configure { gains: None, ..configure }),
        &std::format!("13 01 {own_design} {}", "00 ".repeat(16)),
    );
    let one_second = head.replacen("01 01 00 00", "01 01 e8 03", 1);
    assert_bytes(
        1,
        Message::Configure(Configure { watchdog_timeout_ms: 1_000, ..configure }),
        &std::format!("13 01 {one_second} {gains}"),
    );
    let paced = head.replacen("01 01 00 00", "01 03 fe ff", 1);
    let configure = Configure { paced_by_target: true, watchdog_timeout_ms: 0xfffe, ..configure };
    assert_bytes(1, Message::Configure(configure), &std::format!("13 01 {paced} {gains}"));
    let neither = head.replacen("01 01 00 00", "01 02 fe ff", 1);
    let configure = Configure { gains: None, ..configure };
    assert_bytes(1, Message::Configure(configure), &std::format!("13 01 {neither} {}", "00 ".repeat(16)));
}

#[test]
fn a_loop_delay_makes_configure_four_bytes_longer() {
    let delayed = Configure { loop_delay_us: 0x0102_0304, ..CONFIGURE };
    let Configure { period_us, start_frequency_mhz, .. } = delayed;
    let body = encoded_body(&Packet { sequence: 1, message: Message::Configure(delayed) });
    assert_eq!(body.len(), 58);
    assert_eq!((body[3], &body[54..]), (0b101, &[4, 3, 2, 1][..]));
    assert_eq!(body[6..14], [period_us.to_le_bytes(), start_frequency_mhz.to_le_bytes()].concat());
    assert_eq!(Packet::decode(&body).unwrap().message, Message::Configure(delayed));
    // Invalid: the bit without the four bytes, the bytes without the bit, a delay of zero.
    assert_eq!(Packet::decode(&body[..54]), Err(MessageError::Length));
    let mut other = body.clone();
    other[3] = 1;
    assert_eq!(Packet::decode(&other), Err(MessageError::Length));
    other[3] = 0b101;
    other[54..].fill(0);
    assert_eq!(Packet::decode(&other), Err(MessageError::Field));
}

#[test]
fn configured_is_twenty_bytes() {
    assert_bytes(
        2,
        Message::Configured(Configured { outcome: Ok(GAINS) }),
        "14 02 00 00 00 00 80 3f 00 00 00 c0 00 00 00 3f 00 00 80 40",
    );
    assert_bytes(
        2,
        Message::Configured(Configured { outcome: Err(Rejection::Law) }),
        "14 02 02 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
    );
}

#[test]
fn sample_is_eighteen_bytes() {
    let sample = Sample { time_us: 0x0102_0304, setpoint_um: 2.0, wd_um: 1.5, wq_um: -0.25 };
    assert_bytes(7, Message::Sample(sample), "15 07 04 03 02 01 00 00 00 40 00 00 c0 3f 00 00 80 be");
}

#[test]
fn command_is_eighteen_bytes() {
    let command = Command {
        target_time_us: 0x0a0b_0c0d,
        drive_vpp: 400.0,
        frequency_mhz: 32_307_600,
        state: ControllerState::Running,
        cause: StateCause::None,
        flags: flags::SATURATED | flags::FREQUENCY_HELD,
        compute_us: 300,
    };
    assert_bytes(7, Message::Command(command), "16 07 0d 0c 0b 0a 00 00 c8 43 90 f9 ec 01 01 05 2c 01");
    let stopped =
        Command { drive_vpp: 0.0, state: ControllerState::Fault, cause: StateCause::NonFinite, flags: 0, ..command };
    assert_bytes(7, Message::Command(stopped), "16 07 0d 0c 0b 0a 00 00 00 00 90 f9 ec 01 02 30 2c 01");
}

#[test]
fn fault_is_twenty_bytes() {
    let report = FaultReport { code: 2, pc: 0x0800_1234, lr: 0x0800_0001, cfsr: 0x0100_0000, address: 0xdead_beef };
    assert_bytes(0, Message::Fault(report), "18 00 02 00 34 12 00 08 01 00 00 08 00 00 00 01 ef be ad de");
}

#[test]
fn tick_is_six_bytes() {
    assert_bytes(5, Message::Tick(Tick { target_time_us: 0x0102_0304 }), "19 05 04 03 02 01");
}

#[test]
fn one_bit_of_configure_selects_the_own_plate() {
    let own = Configure { drives_own_plate: true, watchdog_timeout_ms: 250, ..CONFIGURE };
    let body = encoded_body(&Packet { sequence: 1, message: Message::Configure(own) });
    assert_eq!(body[..6], hex("13 01 01 09 fa 00"));
    assert_eq!(body[6..], encoded_body(&Packet { sequence: 1, message: Message::Configure(CONFIGURE) })[6..]);
    assert_eq!(Packet::decode(&body).unwrap().message, Message::Configure(own));
}

#[test]
fn setpoint_is_six_bytes() {
    assert_bytes(6, Message::Setpoint(Setpoint { setpoint_um: 2.0 }), "1a 06 00 00 00 40");
}

#[test]
fn telemetry_is_thirty_seven_bytes() {
    let telemetry = Telemetry {
        period: 0x0102_0304,
        target_time_us: 0x0a0b_0c0d,
        setpoint_um: 2.0,
        wd_um: 1.5,
        wq_um: -0.25,
        drive_vpp: 400.0,
        frequency_mhz: 32_307_600,
        force_n: Some(0.5),
        state: ControllerState::Running,
        cause: StateCause::None,
        flags: flags::SATURATED,
    };
    let head = "1b 05 04 03 02 01 0d 0c 0b 0a 00 00 00 40 00 00 c0 3f 00 00 80 be 00 00 c8 43 90 f9 ec 01";
    assert_bytes(5, Message::Telemetry(telemetry), &std::format!("{head} 00 00 00 3f 01 01 01"));
    let force = |force_n| Message::Telemetry(Telemetry { force_n, ..telemetry });
    assert_bytes(5, force(Some(0.0)), &std::format!("{head} 00 00 00 00 01 01 01"));
    assert_bytes(5, force(None), &std::format!("{head} 00 00 00 00 01 01 00"));
    let stopped = Telemetry { state: ControllerState::Fault, cause: StateCause::NonFinite, flags: 0, ..telemetry };
    assert_bytes(5, Message::Telemetry(stopped), &std::format!("{head} 00 00 00 3f 02 30 01"));
    for wrong in ["04 01 01", "01 41 01", "01 01 02", "01 01"] {
        assert!(Packet::decode(&hex(&std::format!("{head} 00 00 00 3f {wrong}"))).is_err(), "{wrong}");
    }
    // 43 bytes per message at 1 kHz and ten bits a byte are 430 kbit/s.
    assert_eq!(Packet { sequence: 1, message: Message::Telemetry(telemetry) }.encode().as_bytes().len(), 43);
}

#[test]
fn unsolicited_messages_answer_no_request() {
    assert!(Message::Tick(Tick { target_time_us: 0 }).is_unsolicited());
    assert!(!Message::Setpoint(Setpoint { setpoint_um: 0.0 }).is_unsolicited() && !Message::Safe.is_unsolicited());
}

#[test]
fn cyclic_frames_always_have_twenty_four_bytes() {
    for value in [0.0, 1.0, f32::MAX, f32::NAN, f32::from_bits(u32::MAX)] {
        let sample = Sample { time_us: value.to_bits(), setpoint_um: value, wd_um: value, wq_um: value };
        assert_eq!(Packet { sequence: 0, message: Message::Sample(sample) }.encode().as_bytes().len(), 24);
    }
}

#[test]
fn rejects_other_versions_kinds_lengths_and_fields() {
    assert_eq!(Packet::decode(&hex("21 00")), Err(MessageError::Version(2)));
    assert_eq!(Packet::decode(&hex("10 00")), Err(MessageError::Kind(0)));
    assert_eq!(Packet::decode(&hex("1c 00")), Err(MessageError::Kind(12)));
    assert_eq!(Packet::decode(&hex("19 00 01 02 03")), Err(MessageError::Length));
    assert_eq!(Packet::decode(&hex("19 00 01 02 03 04 05")), Err(MessageError::Length));
    let configure = hex(&std::format!("13 00 01 03 {}", "00 ".repeat(50)));
    assert!(Packet::decode(&configure).is_ok());
    let unknown_bit = hex(&std::format!("13 00 01 10 {}", "00 ".repeat(50)));
    assert_eq!(Packet::decode(&unknown_bit), Err(MessageError::Field));
    assert_eq!(Packet::decode(&[]), Err(MessageError::Length));
    assert_eq!(Packet::decode(&hex("11")), Err(MessageError::Length));
    assert_eq!(Packet::decode(&hex("11 00 00")), Err(MessageError::Length));
    let command = hex("16 07 0d 0c 0b 0a 00 00 c8 43 90 f9 ec 01 01 05 2c 01");
    assert_eq!(Packet::decode(&command[..17]), Err(MessageError::Length));
    for (byte, value) in [(14, 4), (15, 0x45)] {
        let mut wrong = command.clone();
        wrong[byte] = value;
        assert_eq!(Packet::decode(&wrong), Err(MessageError::Field), "byte {byte}");
    }
}

#[test]
fn law_names_round_trip() {
    for law in LawId::ALL {
        assert_eq!(LawId::from_name(law.name()), Some(law));
    }
    assert_eq!(LawId::from_name("dq-pid"), None);
}

proptest! {
    #[test]
    fn decoded_messages_encode_to_the_same_meaning(
        body in proptest::collection::vec(any::<u8>(), 0..=MAX_BODY), kind in 0x10_u8..0x1d,
    ) {
        let mut body = body;
        if let Some(first) = body.first_mut() {
            *first = kind;
        }
        if let Ok(packet) = Packet::decode(&body) {
            prop_assert_eq!(encoded_body(&Packet::decode(&encoded_body(&packet)).unwrap()), encoded_body(&packet));
        }
    }

    #[test]
    fn any_sample_round_trips(sequence: u8, time_us: u32, setpoint_um: f32, wd_um: f32, wq_um: f32) {
        let packet = Packet { sequence, message: Message::Sample(Sample { time_us, setpoint_um, wd_um, wq_um }) };
        prop_assert_eq!(Packet::decode(&encoded_body(&packet)), Ok(packet));
    }
}
