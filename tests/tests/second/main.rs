//! A second opinion on every bit: the same samples to the controller in this process, to the firmware image on the emulated board, and to the same controller executed
//! by QEMU, an implementation of the processor that shares nothing with the first.
//!
//! Needs `qemu-system-arm` (`ci/install-test-tools`). Where it is missing the tests say so and pass, unless `PLATEBENCH_REQUIRE_ALL=1` asks for all of them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on ends by panicking")]

mod qemu;
mod recorded_trials;

use platebench_rig::{EmulatedLink, Link};
use platebench_wire::{Command, LawId, Message, Packet, PacketReader};
use qemu::Qemu;
use recorded_trials::{RecordedExchange, RecordedTrial};

/// Sent at once: far fewer bytes than the variant's ring holds.
const MAX_BYTES_PER_WRITE: usize = 64;

/// Plays a conversation to QEMU and says where it answers otherwise. Its clock is that of the samples, so that every byte must agree.
fn compare_with_qemu(qemu: &mut Qemu, conversation: &RecordedTrial) -> Result<(), String> {
    for part in conversation.exchanges.chunks(MAX_BYTES_PER_WRITE) {
        let questions: Vec<u8> = part.iter().flat_map(|exchange| exchange.request.clone()).collect();
        let length = part.iter().map(|exchange| exchange.answer.len()).sum();
        let answers =
            qemu.exchange(&questions, length).map_err(|problem| format!("{}: {problem}", conversation.name))?;
        let mut at = 0;
        for exchange in part {
            let answer = &answers[at..at + exchange.answer.len()];
            at += answer.len();
            if answer != exchange.answer {
                return Err(difference(conversation, exchange, answer));
            }
        }
    }
    Ok(())
}

/// Plays a conversation to the emulated board, which has a clock of its own: when it answered and how long that took are left out.
fn compare_with_emulated(emulated: &mut EmulatedLink, conversation: &RecordedTrial) -> Result<(), String> {
    emulated.restart().unwrap();
    for exchange in &conversation.exchanges {
        let mut answer = Vec::new();
        emulated.exchange(exchange.now, &exchange.request, &mut answer).unwrap();
        if without_times(&answer) != without_times(&exchange.answer) {
            return Err(difference(conversation, exchange, &answer));
        }
    }
    Ok(())
}

/// What was said.
fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).map(Result::unwrap).collect()
}

/// What was said without the target's times, as frames: two floats that are equal may differ in their bits.
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

fn difference(conversation: &RecordedTrial, exchange: &RecordedExchange, answer: &[u8]) -> String {
    format!(
        "{} at {:?}: to {:?} the answer is {:?}, expected {:?}",
        conversation.name,
        exchange.now,
        packets(&exchange.request),
        packets(answer),
        packets(&exchange.answer)
    )
}

fn samples(conversations: &[RecordedTrial]) -> usize {
    conversations.iter().map(|conversation| conversation.exchanges.len()).sum()
}

#[test]
fn paper_scenarios_give_equal_bits_on_all_targets() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let mut emulated = EmulatedLink::built_in().unwrap();
    let mut count = 0;
    for law in LawId::ALL {
        let conversations = recorded_trials::record_paper_scenarios(law);
        assert!(conversations.len() >= 20, "{} conversations under {}", conversations.len(), law.name());
        for conversation in &conversations {
            compare_with_emulated(&mut emulated, conversation).unwrap();
            compare_with_qemu(&mut qemu, conversation).unwrap();
        }
        count += samples(&conversations);
    }
    assert!(count >= 10_000, "only {count} exchanges");
    qemu.finish().unwrap();
}

#[test]
fn random_samples_give_equal_bits_on_qemu() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let conversations = recorded_trials::record_random_samples(3_000);
    for conversation in &conversations {
        compare_with_qemu(&mut qemu, conversation).unwrap();
    }
    assert!(samples(&conversations) >= 3_000);
    qemu.finish().unwrap();
}

#[test]
fn one_wrong_bit_is_found() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    let mut conversation = recorded_trials::record_random_samples(100).remove(0);
    compare_with_qemu(&mut qemu, &conversation).unwrap();
    let mut emulated = EmulatedLink::built_in().unwrap();
    compare_with_emulated(&mut emulated, &conversation).unwrap();
    conversation.flip_a_bit_of_the_last_drive();
    let found = compare_with_qemu(&mut qemu, &conversation).unwrap_err();
    assert!(found.contains("the answer is") && found.contains("drive_vpp"), "{found}");
    compare_with_emulated(&mut emulated, &conversation).unwrap_err();
}

#[test]
fn a_terminated_qemu_is_reported() {
    let Some(mut qemu) = Qemu::start_if_installed() else { return };
    qemu.kill();
    let problem = qemu.exchange(&[0], 1).unwrap_err();
    assert!(problem.contains("QEMU"), "{problem}");
}
