//! Tests content and delay of the answers of the firmware, and the control paced by the board's timer.

use super::{CONFIGURE, PERIOD, firmware_under_test, open_logged, sample};
use crate::provenance::source_hash;
use platebench_rig::emulated::EmulatedOptions;
use platebench_rig::{Chip, EmulatedLink, HostedLink, Link, Session, WallClockLink};
use platebench_test_kit::{random_configure, uniform};
use platebench_wire::{Configure, ControllerState, LawId, Message, Packet, PacketReader, Sample, StateCause, Tick};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// Last instruction of flash.
const NEVER_EXECUTED: u32 = 0x081F_FFFE;
/// Time of two frames of 24 bytes and one byte of idle line; 10 µs per byte at 1 Mbaud.
const SAMPLE_AND_COMMAND: Duration = Duration::from_micros((24 + 1 + 24) * 10);

#[test]
fn reads_the_identity_of_the_firmware() {
    let session = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    let identity = session.identity();
    assert_eq!(session.firmware_name(), "platebench-f4");
    assert_eq!(identity.version.map(|number| number.to_string()).join("."), env!("CARGO_PKG_VERSION"));
    assert!(LawId::ALL.into_iter().all(|law| identity.has_law(law)));
    assert_eq!(identity.build, source_hash::source_hash(&firmware_under_test()).unwrap()[..8]);
    assert_eq!(identity.chip & 0xFFF, 0x419);
    assert_eq!(&identity.unique, b"emulated-427");
    assert_eq!(session.link().baud(), 1_000_000);
}

/// Finite samples of a plate, so that the controller goes on.
fn random_sample(random: &mut ChaCha8Rng, time_us: u32) -> Sample {
    let setpoint_um = uniform(random, 0.0, 4.0);
    // Wd is sometimes almost zero, and Wq sometimes that of a broken sensor cable.
    let wd_um = if random.next_u32().is_multiple_of(16) { 1e-9 } else { uniform(random, -1.0, 4.0) };
    let wq_um = if random.next_u32().is_multiple_of(64) { 1e6 } else { uniform(random, -1.0, 1.0) };
    Sample { time_us, setpoint_um, wd_um, wq_um }
}

#[test]
fn answers_random_samples_with_the_bits_of_the_host() {
    let mut emulated = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    let mut hosted = Session::open(HostedLink::new()).unwrap();
    for law in LawId::ALL {
        for seed in 0..4 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let configure = random_configure(law, &mut random);
            let gains = [emulated.start_trial(&configure).unwrap(), hosted.start_trial(&configure).unwrap()];
            assert_eq!(format!("{:?}", gains[0]), format!("{:?}", gains[1]), "{law:?}");
            let mut moved = 0;
            let mut before = None;
            for index in 0..500 {
                let sample = random_sample(&mut random, index * 1_000);
                let answer = |reply: Option<platebench_rig::Reply>| {
                    let command = reply.unwrap().command;
                    (command.drive_vpp.to_bits(), command.frequency_mhz, command.state, command.cause, command.flags)
                };
                let expected = answer(hosted.send_sample(index * PERIOD, &sample).unwrap());
                assert_eq!(
                    answer(emulated.send_sample(index * PERIOD, &sample).unwrap()),
                    expected,
                    "{law:?} {sample:?}"
                );
                moved += u32::from(before.replace(expected) != Some(expected));
            }
            assert!(moved > 100, "{law:?}: only {moved} answers differ from the one before");
        }
    }
}

#[test]
fn stops_after_five_periods_without_a_sample() {
    let mut session = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    assert!(session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap().command.drive_vpp > 400.0);
    assert_eq!(session.advance_to(Duration::from_micros(5_200)).unwrap(), None);
    // The firmware checks the timeout every millisecond, and its command takes 0.25 ms on the wire.
    let command = session.advance_to(Duration::from_micros(6_600)).unwrap().unwrap();
    assert_eq!(
        (command.state, command.cause, command.drive_vpp),
        (ControllerState::Fault, StateCause::SampleTimeout, 0.0)
    );
}

#[test]
fn keeps_its_clock_with_the_bench() {
    let mut session = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    let mut time = |index: u32| {
        let reply = session.send_sample(index * PERIOD, &sample(2.0, 0.0)).unwrap().unwrap();
        reply.command.target_time_us
    };
    let first = time(0);
    for index in 1..200 {
        let drift = time(index).wrapping_sub(first).abs_diff(index * 1_000);
        assert!(drift <= 2, "{drift} us after {index} ms");
    }
}

#[test]
fn stops_after_five_corrupted_samples() {
    let mut link = EmulatedLink::built_in().unwrap();
    let packet = |sequence, message| Packet { sequence, message }.encode().as_bytes().to_vec();
    let good = |sequence| packet(sequence, Message::Sample(sample(2.0, 0.5)));
    let mut answer = Vec::new();
    link.exchange(Duration::ZERO, &packet(1, Message::Configure(CONFIGURE)), &mut answer).unwrap();
    answer.clear();
    assert!(link.exchange(PERIOD, &good(2), &mut answer).unwrap() > SAMPLE_AND_COMMAND);
    assert!(link.instruction_count().unwrap() > 100);
    for index in 0..5 {
        let mut bad = good(3);
        bad[9] ^= 0x10;
        answer.clear();
        assert_eq!(link.exchange((2 + index) * PERIOD, &bad, &mut answer).unwrap(), Duration::ZERO);
        assert_eq!(link.instruction_count(), None);
        assert_eq!(answer.is_empty(), index < 4, "{answer:?}");
    }
    let stop = PacketReader::new().packets(&answer).next();
    let Some(Ok(Packet { message: Message::Command(command), .. })) = stop else { panic!("{stop:?}") };
    assert_eq!((command.state, command.cause, command.drive_vpp), (ControllerState::Fault, StateCause::LineNoise, 0.0));
}

#[test]
fn answers_the_first_whole_frame_after_half_a_frame() {
    let mut link = EmulatedLink::built_in().unwrap();
    let hello = |sequence| Packet { sequence, message: Message::Hello }.encode();
    let mut answer = Vec::new();
    assert_eq!(link.exchange(PERIOD, &hello(1).as_bytes()[..4], &mut answer).unwrap(), Duration::ZERO);
    // The delimiter of this hello ends the damaged frame, and the firmware rejects both.
    assert_eq!(link.exchange(2 * PERIOD, hello(2).as_bytes(), &mut answer).unwrap(), Duration::ZERO);
    assert!(answer.is_empty(), "{answer:?}");
    assert!(link.exchange(3 * PERIOD, hello(3).as_bytes(), &mut answer).unwrap() > Duration::from_micros(500));
    assert!(!answer.is_empty());
}

#[test]
fn delays_by_wire_and_computing_time() {
    let delays = |options| {
        let emulated = EmulatedLink::new(&super::image("platebench-stm32f4.elf"), options).unwrap();
        assert_eq!(emulated.baud(), 1_000_000);
        let mut session = Session::open(emulated).unwrap();
        session.start_trial(&CONFIGURE).unwrap();
        let delay = |index| session.send_sample(index * PERIOD, &sample(2.0, 0.3)).unwrap().unwrap().delay;
        (0..50).map(delay).collect::<Vec<_>>()
    };
    let first = delays(EmulatedOptions::default());
    for delay in &first {
        let computing = delay.checked_sub(SAMPLE_AND_COMMAND).unwrap();
        assert!((Duration::from_micros(1)..Duration::from_micros(30)).contains(&computing), "{computing:?}");
    }
    assert_eq!(delays(EmulatedOptions::default()), first);
    // The internal oscillator gives the same baud rate and clock.
    let without_crystal = delays(EmulatedOptions { crystal_hz: 0, ..EmulatedOptions::default() });
    for (with, without) in first.iter().zip(&without_crystal) {
        assert!(with.abs_diff(*without) < Duration::from_micros(5), "{with:?} {without:?}");
    }
}

#[test]
fn repeats_a_trial_bit_for_bit_after_others() {
    let trial = |session: &mut Session<_>, law| {
        session.start_trial(&Configure { law, ..CONFIGURE }).unwrap();
        for index in 0..20 {
            session.send_sample(index * PERIOD, &sample(2.0, 0.1 * index as f32)).unwrap();
        }
        session.advance_to(Duration::from_millis(30)).unwrap();
    };
    let (mut fresh, log) = open_logged(EmulatedLink::built_in().unwrap());
    trial(&mut fresh, LawId::DqPi);
    let expected = log.lock().unwrap().clone();
    assert_eq!(expected.len(), 22);

    let (mut used, log) = open_logged(EmulatedLink::built_in().unwrap());
    trial(&mut used, LawId::DqPiEuler);
    // A failed assertion with the lock held would also panic in `Session::drop`.
    let other = log.lock().unwrap().clone();
    assert_ne!(other, expected);
    used.send_sample(Duration::from_millis(31), &sample(f32::NAN, 0.0)).unwrap();
    used.request_safe_state();
    trial(&mut used, LawId::OpenLoop);
    trial(&mut used, LawId::DqPi);
    let again = log.lock().unwrap().clone();
    assert_eq!(again, expected);

    // The record of an instruction prevents that a restart skips the start of the firmware.
    used.link_mut().link.record_execution(&BTreeSet::from([NEVER_EXECUTED]));
    trial(&mut used, LawId::DqPi);
    let after_power_on = log.lock().unwrap().clone();
    assert_eq!(after_power_on, expected);
}

#[test]
fn waits_for_the_wire_if_the_period_is_shorter() {
    let mut session = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    let period = Duration::from_micros(200);
    session.start_trial(&Configure { period_us: 200, ..CONFIGURE }).unwrap();
    for index in 0..100 {
        let reply = session.send_sample(index * period, &sample(2.0, 0.3)).unwrap().unwrap();
        assert_eq!(reply.command.state, ControllerState::Running, "sample {index}");
        assert!(reply.delay > SAMPLE_AND_COMMAND);
    }
}

#[test]
fn measures_the_stack_use() {
    let mut session = Session::open(EmulatedLink::built_in().unwrap()).unwrap();
    for _ in 0..2 {
        session.start_trial(&CONFIGURE).unwrap();
        session.send_sample(Duration::ZERO, &sample(2.0, 0.3)).unwrap().unwrap();
        let used = session.link().stack_used().unwrap();
        assert!((200..4_096).contains(&used), "{used} bytes");
    }
}

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
