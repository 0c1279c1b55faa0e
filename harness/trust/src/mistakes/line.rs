//! Frames that are taken for what they are not, and states that are left without being told to.

use crate::middleware::Mistake;
use platebench_wire::{Command, Configure, Encoded, Message, Packet, State};

/// Bytes of the checksum behind a body.
const CHECKSUM: usize = 4;

/// Never looks at the checksum.
pub(crate) struct Credulous;

impl Mistake for Credulous {
    fn garbage(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let content = frame.strip_suffix(&[0]).and_then(unstuffed);
        let body = content.as_deref().and_then(|content| content.get(..content.len().checked_sub(CHECKSUM)?));
        let believed = body.filter(|body| Packet::decode(body).is_ok()).and_then(Encoded::new);
        Some(believed.map_or_else(|| frame.to_vec(), |frame| frame.as_bytes().to_vec()))
    }
}

/// What COBS stuffed, without its delimiter.
fn unstuffed(mut stuffed: &[u8]) -> Option<Vec<u8>> {
    let mut content = Vec::new();
    while let Some((&code, rest)) = stuffed.split_first() {
        let length = usize::from(code).checked_sub(1)?;
        content.extend_from_slice(rest.get(..length)?);
        stuffed = rest.get(length..)?;
        if code < u8::MAX && !stuffed.is_empty() {
            content.push(0);
        }
    }
    Some(content)
}

/// Skips what it cannot read and never counts it.
pub(crate) struct Thoughtless;

impl Mistake for Thoughtless {
    fn garbage(&mut self, _frame: &[u8]) -> Option<Vec<u8>> {
        None
    }
}

/// Never looks at a sample's number: a doubled one is controlled with twice.
#[derive(Default)]
pub(crate) struct Uncounted {
    own: u8,
    theirs: u8,
}

impl Mistake for Uncounted {
    fn take(&mut self, packet: &mut Packet) {
        self.theirs = packet.sequence;
        self.own = self.own.wrapping_add(1);
        packet.sequence = self.own;
    }

    fn give(&mut self, packet: &mut Packet) {
        packet.sequence = self.theirs;
    }
}

/// A controller that stopped goes on by itself with the next sample.
#[derive(Default)]
pub(crate) struct Restless {
    configured: Option<Configure>,
    stopped: bool,
}

impl Mistake for Restless {
    fn configure(&mut self, configure: &mut Configure) {
        *self = Self { configured: Some(*configure), stopped: false };
    }

    fn give(&mut self, packet: &mut Packet) {
        if let Message::Command(Command { state, .. }) = packet.message {
            self.stopped = state == State::Fault;
        }
    }

    fn before(&mut self, sequence: u8) -> Option<Packet> {
        let configure = self.configured.filter(|_| std::mem::take(&mut self.stopped))?;
        // Its answer carries a number that nobody waits for.
        Some(Packet { sequence: sequence.wrapping_sub(1), message: Message::Configure(configure) })
    }
}
