//! Sends random, mutated and spliced byte strings to frame reader, decoder and device. Compares the
//! frame reader with a second one that is written after `docs/wire-protocol.md` without common
//! code. The random numbers are deterministic, so a round that fails, fails again.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a panic fails the test")]

use platebench_controller::Device;
use platebench_wire::{
    Command, Configure, ControllerState, FrameReader, Identity, LawId, MAX_ENCODED, Message, Packet, Sample,
    capabilities,
};

const ROUNDS: u64 = 2_000_000;
const STRINGS_PER_DEVICE: u64 = 200;

const LIMIT_VPP: f32 = 900.0;

/// Marsaglia's random generator xorshift64*.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 16
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }

    fn bytes(&mut self, into: &mut Vec<u8>, count: usize) {
        for _ in 0..count {
            // A zero ends a frame and is rare among random bytes, so a sixteenth is set to 0.
            let byte = self.next() as u16;
            into.push(if byte < 0x1000 { 0 } else { byte as u8 });
        }
    }
}

#[derive(Default)]
struct ReferenceFrameReader {
    since_delimiter: Vec<u8>,
}

#[derive(Debug, PartialEq)]
enum ByteOutcome {
    Nothing,
    Refused,
    Body(Vec<u8>),
}

impl ReferenceFrameReader {
    fn push(&mut self, byte: u8) -> ByteOutcome {
        if byte != 0 {
            if self.since_delimiter.len() <= MAX_ENCODED {
                self.since_delimiter.push(byte);
            }
            return ByteOutcome::Nothing;
        }
        let frame = std::mem::take(&mut self.since_delimiter);
        if frame.is_empty() {
            return ByteOutcome::Nothing;
        }
        Self::body(&frame).map_or(ByteOutcome::Refused, ByteOutcome::Body)
    }

    fn body(frame: &[u8]) -> Option<Vec<u8>> {
        if frame.len() > MAX_ENCODED {
            return None;
        }
        let (mut data, mut rest) = (Vec::new(), frame);
        while let Some((&code, behind)) = rest.split_first() {
            let length = usize::from(code) - 1;
            data.extend_from_slice(behind.get(..length)?);
            rest = &behind[length..];
            if !rest.is_empty() {
                data.push(0);
            }
        }
        let crc = data.split_off(data.len().checked_sub(4)?);
        (crc == crc_32(&data).to_le_bytes()).then_some(data)
    }
}

fn crc_32(data: &[u8]) -> u32 {
    !data
        .iter()
        .fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc: u32, _| (crc >> 1) ^ (0xEDB8_8320 * (crc & 1))))
}

fn random_message(random: &mut Random) -> Packet {
    let sequence = random.next() as u8;
    let small = |random: &mut Random| random.below(4_000) as f32 / 1_000.0;
    let message = match random.below(16) {
        0 => Message::Hello,
        1 => Message::Safe,
        2..=4 => Message::Configure(Configure {
            law: LawId::ALL[random.below(LawId::ALL.len())],
            paced_by_target: random.below(4) == 0,
            drives_own_plate: false,
            watchdog_timeout_ms: random.below(3) as u16 * 10,
            period_us: 1_000,
            loop_delay_us: random.below(5) as u32 * 300,
            start_frequency_mhz: 32_307_600,
            gain_um_per_vpp: 0.00698,
            time_constant_s: if random.below(8) == 0 { f32::from_bits(random.next() as u32) } else { 1.88e-3 },
            response_time_s: 0.0,
            drive_limit_vpp: LIMIT_VPP,
            frequency_range_hz: 250.0,
            frequency_slew_hz: 100.0,
            gains: None,
        }),
        _ => Message::Sample(Sample {
            time_us: random.next() as u32,
            setpoint_um: small(random),
            wd_um: if random.below(64) == 0 { f32::from_bits(random.next() as u32) } else { small(random) },
            wq_um: small(random) - 2.0,
        }),
    };
    Packet { sequence, message }
}

fn random_framed_body(random: &mut Random, into: &mut Vec<u8>) {
    let mut body = vec![0x10 | random.below(16) as u8];
    let length = [1, 2, 6, 18, 20, 50, 54, 58, 64][random.below(9)];
    random.bytes(&mut body, length - 1);
    into.extend_from_slice(platebench_wire::EncodedFrame::new(&body).unwrap().as_bytes());
}

fn mutate(random: &mut Random, bytes: &mut Vec<u8>) {
    for _ in 0..=random.below(3) {
        let Some(last) = bytes.len().checked_sub(1) else { return };
        let at = random.below(last + 1);
        match random.below(6) {
            0 => bytes[at] ^= 1 << random.below(8),
            1 => bytes[at] = random.next() as u8,
            2 => bytes.truncate(at),
            3 => drop(bytes.remove(at)),
            4 => bytes.insert(at, random.next() as u8),
            _ => {
                let again = bytes[at..].to_vec();
                bytes.extend(again);
            }
        }
    }
}

fn next_byte_string(random: &mut Random, into: &mut Vec<u8>) {
    into.clear();
    match random.below(8) {
        0 => {
            let count = random.below(120);
            random.bytes(into, count);
        }
        1 => random_framed_body(random, into),
        2..=4 => into.extend_from_slice(random_message(random).encode().as_bytes()),
        _ => {
            into.extend_from_slice(random_message(random).encode().as_bytes());
            if random.below(4) == 0 {
                into.extend_from_slice(random_message(random).encode().as_bytes());
            }
            mutate(random, into);
        }
    }
}

#[derive(Default)]
struct Counts {
    bodies: u64,
    refused: u64,
    driven: u64,
    ticks: u64,
}

fn feed_byte(
    byte: u8,
    now_us: u32,
    reader: &mut FrameReader,
    page: &mut ReferenceFrameReader,
    device: &mut Device,
    counts: &mut Counts,
) {
    let completed = page.push(byte);
    let read = match reader.push(byte) {
        None => ByteOutcome::Nothing,
        Some(Err(_)) => ByteOutcome::Refused,
        Some(Ok(body)) => ByteOutcome::Body(body.to_vec()),
    };
    assert_eq!(read, completed, "the reader and the page agree");
    let sample = match &completed {
        ByteOutcome::Body(body) => {
            counts.bodies += 1;
            body.len() == 18 && body[0] == 0x15
        }
        ByteOutcome::Refused => {
            counts.refused += 1;
            false
        }
        ByteOutcome::Nothing => false,
    };

    let before = *device.output();
    let mut answers = 0;
    device.receive(&[byte], now_us, |frame| {
        answers += 1;
        let body = ReferenceFrameReader::body(&frame[..frame.len() - 1]).unwrap();
        if let Message::Command(command) = Packet::decode(&body).unwrap().message {
            assert!(sample || command.state != ControllerState::Running || command.drive_vpp == 0.0, "{completed:?}");
        }
    });
    assert!(answers <= usize::from(completed != ByteOutcome::Nothing), "an answer to nothing");
    let after = device.output();
    if after.state == ControllerState::Running && drive_bits(after) != drive_bits(&before) {
        assert!(sample, "driven by {completed:?}");
        counts.driven += 1;
    }
    assert!(after.state == ControllerState::Running || after.drive_vpp == 0.0, "{after:?}");
    assert!((0.0..=f32::MAX).contains(&after.drive_vpp), "{after:?}");
}

fn drive_bits(command: &Command) -> (ControllerState, u32, u32, u32) {
    (command.state, command.drive_vpp.to_bits(), command.frequency_mhz, command.target_time_us)
}

#[test]
fn only_a_complete_sample_drives_the_plate() {
    let identity = Identity {
        version: [0, 1, 0],
        capabilities: capabilities::TARGET_PACED,
        laws: 0b111,
        build: [0; 8],
        chip: 0,
        unique: [0; 12],
        name: *b"device under tes",
    };
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    let (mut device, mut reader, mut page) =
        (Device::new(identity), FrameReader::new(), ReferenceFrameReader::default());
    let (mut bytes, mut now_us, mut counts) = (Vec::new(), u32::MAX - 1_000_000, Counts::default());
    for round in 0..ROUNDS {
        if round % STRINGS_PER_DEVICE == 0 {
            (device, reader, page) = (Device::new(identity), FrameReader::new(), ReferenceFrameReader::default());
            bytes.clear();
            let packet = std::iter::repeat_with(|| random_message(&mut random));
            let configure = packet.take(1_000).find(|packet| matches!(packet.message, Message::Configure(_))).unwrap();
            bytes.extend_from_slice(configure.encode().as_bytes());
        } else {
            next_byte_string(&mut random, &mut bytes);
        }
        for &byte in &bytes {
            feed_byte(byte, now_us, &mut reader, &mut page, &mut device, &mut counts);
        }
        now_us = now_us.wrapping_add(random.below(2_000) as u32);
        device.tick(now_us, |frame| {
            let packet = Packet::decode(&ReferenceFrameReader::body(&frame[..frame.len() - 1]).unwrap()).unwrap();
            match packet.message {
                Message::Tick(_) => counts.ticks += 1,
                Message::Command(command) => {
                    assert_eq!((command.state, command.drive_vpp), (ControllerState::Fault, 0.0));
                }
                other => panic!("round {round}: {other:?}"),
            }
        });
    }
    // Checks that the random strings reached every branch often enough.
    assert!(counts.bodies > ROUNDS / 4 && counts.refused > ROUNDS / 8, "{} {}", counts.bodies, counts.refused);
    assert!(counts.driven > ROUNDS / 20 && counts.ticks > ROUNDS / 100, "{} {}", counts.driven, counts.ticks);
}

#[test]
fn a_device_has_a_fixed_size() {
    // The device uses no heap, so its size limits its memory.
    assert!(size_of::<FrameReader>() <= MAX_ENCODED + 32);
    assert!(size_of::<Device>() <= 512, "{}", size_of::<Device>());
}
