//! Compares hosted controller, emulated board and QEMU, bit for bit on the same samples.
//!
//! QEMU is an independent implementation of the processor. If `qemu-system-arm` is missing, the
//! tests print a message and pass, but fail with `PLATEBENCH_REQUIRE_ALL=1`.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on ends by panicking")]

mod qemu;
mod recorded_trials;

use platebench_rig::{EmulatedLink, Link};
use platebench_wire::{Command, LawId, Message, Packet, PacketReader};
use qemu::Qemu;
use recorded_trials::{RecordedExchange, RecordedTrial};
use rstest::rstest;

/// Number of exchanges per write. They fill only a small part of the image's receive buffer.
const EXCHANGES_PER_WRITE: usize = 64;

/// QEMU takes its time from the samples, so every byte of the answers must agree.
fn compare_with_qemu(qemu: &mut Qemu, trial: &RecordedTrial) -> Result<(), String> {
    for part in trial.exchanges.chunks(EXCHANGES_PER_WRITE) {
        let requests: Vec<u8> = part.iter().flat_map(|exchange| exchange.request.clone()).collect();
        let length = part.iter().map(|exchange| exchange.answer.len()).sum();
        let answers = qemu.exchange(&requests, length).map_err(|error| format!("{}: {error}", trial.name))?;
        let mut at = 0;
        for exchange in part {
            let answer = &answers[at..at + exchange.answer.len()];
            at += answer.len();
            if answer != exchange.answer {
                return Err(difference(trial, exchange, answer));
            }
        }
    }
    Ok(())
}

/// Ignores the times in the answers, because the emulated board has its own clock.
fn compare_with_emulated(emulated: &mut EmulatedLink, trial: &RecordedTrial) -> Result<(), String> {
    emulated.restart().unwrap();
    for exchange in &trial.exchanges {
        let mut answer = Vec::new();
        emulated.exchange(exchange.now, &exchange.request, &mut answer).unwrap();
        if without_times(&answer) != without_times(&exchange.answer) {
            return Err(difference(trial, exchange, &answer));
        }
    }
    Ok(())
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).map(Result::unwrap).collect()
}

/// Returns frames without the times of the target. Unlike messages, they show all bits of floats.
fn without_times(bytes: &[u8]) -> Vec<Vec<u8>> {
    let timeless = packets(bytes).into_iter().map(|packet| match packet.message {
        Message::Command(command) => {
            let message = Message::Command(Command { target_time_us: 0, compute_us: 0, ..command });
            Packet { message, ..packet }
        }
        _ => packet,
    });
    timeless.map(|packet| packet.encode().as_bytes().to_vec()).collect()
}

fn difference(trial: &RecordedTrial, exchange: &RecordedExchange, answer: &[u8]) -> String {
    format!(
        "{} at {:?}: to {:?} the answer is {:?}, expected {:?}",
        trial.name,
        exchange.now,
        packets(&exchange.request),
        packets(answer),
        packets(&exchange.answer)
    )
}

fn samples(trials: &[RecordedTrial]) -> usize {
    trials.iter().map(|trial| trial.exchanges.len()).sum()
}

#[rstest]
fn paper_scenarios_give_equal_bits_on_all_targets(#[values(0, 1, 2)] part: usize) {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let mut emulated = EmulatedLink::built_in().unwrap();
    let mut count = 0;
    for law in LawId::ALL.into_iter().skip(part).step_by(3) {
        let trials = recorded_trials::record_paper_scenarios(law);
        assert!(trials.len() >= 20, "{} trials under {}", trials.len(), law.name());
        for trial in &trials {
            compare_with_emulated(&mut emulated, trial).unwrap();
            compare_with_qemu(&mut qemu, trial).unwrap();
        }
        count += samples(&trials);
    }
    assert!(count >= 3_000, "only {count} exchanges");
    qemu.finish().unwrap();
}

#[test]
fn random_samples_give_equal_bits_on_qemu() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let trials = recorded_trials::record_random_samples(3_000);
    for trial in &trials {
        compare_with_qemu(&mut qemu, trial).unwrap();
    }
    assert!(samples(&trials) >= 3_000);
    qemu.finish().unwrap();
}

#[test]
fn one_wrong_bit_is_found() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let mut trial = recorded_trials::record_random_samples(100).remove(0);
    compare_with_qemu(&mut qemu, &trial).unwrap();
    let mut emulated = EmulatedLink::built_in().unwrap();
    compare_with_emulated(&mut emulated, &trial).unwrap();
    trial.flip_a_bit_of_the_last_drive();
    let message = compare_with_qemu(&mut qemu, &trial).unwrap_err();
    assert!(message.contains("the answer is") && message.contains("drive_vpp"), "{message}");
    compare_with_emulated(&mut emulated, &trial).unwrap_err();
}

#[test]
fn a_terminated_qemu_is_reported() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    qemu.kill();
    let error = qemu.exchange(&[0], 1).unwrap_err();
    assert!(error.contains("QEMU"), "{error}");
}
