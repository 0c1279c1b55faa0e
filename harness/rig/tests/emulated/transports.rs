//! Compares the transports of the emulated line: words in blocks and words one by one.

use super::*;
use platebench_model::record::Transport;
use platebench_rig::EmulatedLink;
use platebench_wire::{Message, Packet};

const SILENCE: Duration = Duration::from_millis(300);
/// More bytes than the firmware's ring takes without an idle line.
const LONG_MESSAGE: usize = 700;

type Calls = Vec<(Vec<u8>, Duration, Option<u64>)>;

fn play(transport: Transport) -> (Calls, Transport) {
    let (mut session, log) = open_logged(EmulatedLink::built_in().unwrap());
    session.link_mut().link.set_transport(transport);
    session.start_trial(&CONFIGURE).unwrap();
    let mut now = Duration::ZERO;
    for index in 0..20_u8 {
        session.send_sample(now, &sample(2.0, f32::from(index) * 0.1)).unwrap();
        now += PERIOD;
    }
    let link = session.link_mut();
    let hello = Packet { sequence: 7, message: Message::Hello }.encode();
    let (start, end) = hello.as_bytes().split_at(4);
    let mut received = Vec::new();
    // A message in two parts, noise before a message, two messages at once, and one without a pause.
    link.exchange(now, start, &mut received).unwrap();
    link.exchange(now + PERIOD / 10, end, &mut received).unwrap();
    let noise: Vec<u8> = (0..LONG_MESSAGE).map(|index| (index % 255) as u8 + 1).collect();
    link.exchange(now + 2 * PERIOD, &noise, &mut received).unwrap();
    link.exchange(now + 2 * PERIOD, &[&[0], hello.as_bytes(), hello.as_bytes()].concat(), &mut received).unwrap();
    link.exchange(now + 2 * PERIOD, hello.as_bytes(), &mut received).unwrap();
    link.advance_to(now + 3 * PERIOD, &mut received).unwrap();
    // The watchdog reports its stop without a request.
    link.advance_to(now + SILENCE, &mut received).unwrap();
    let transport = link.link.transport();
    let calls = log.lock().unwrap().clone();
    (calls, transport)
}

#[test]
fn blocks_and_words_give_the_same_bytes_delays_and_counts() {
    let (words, as_words) = play(Transport::Words);
    let (blocks, as_blocks) = play(Transport::Blocks);
    assert_eq!((as_words, as_blocks), (Transport::Words, Transport::Blocks));
    for (index, (word, block)) in words.iter().zip(&blocks).enumerate() {
        assert_eq!(word, block, "call {index}");
    }
    assert_eq!(words.len(), blocks.len());
}
