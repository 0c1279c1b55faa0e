//! Mutates the treatment of frames and states.

use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, ControllerState, EncodedFrame, Message, Packet};

const CHECKSUM_BYTES: usize = 4;

pub(crate) struct NoChecksumCheck;

impl Mutant for NoChecksumCheck {
    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let content = frame.strip_suffix(&[0]).and_then(decode_cobs);
        let body = content.as_deref().and_then(|content| content.get(..content.len().checked_sub(CHECKSUM_BYTES)?));
        let accepted = body.filter(|body| Packet::decode(body).is_ok()).and_then(EncodedFrame::new);
        Some(accepted.map_or_else(|| frame.to_vec(), |frame| frame.as_bytes().to_vec()))
    }
}

fn decode_cobs(mut stuffed: &[u8]) -> Option<Vec<u8>> {
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

pub(crate) struct NoBadFrameCount;

impl Mutant for NoBadFrameCount {
    fn on_unreadable_frame(&mut self, _frame: &[u8]) -> Option<Vec<u8>> {
        None
    }
}

/// Executes a control step for every sample, also for a repeated one.
#[derive(Default)]
pub(crate) struct NoSequenceCheck {
    own_sequence: u8,
    bench_sequence: u8,
}

impl Mutant for NoSequenceCheck {
    fn on_receive(&mut self, packet: &mut Packet) {
        self.bench_sequence = packet.sequence;
        self.own_sequence = self.own_sequence.wrapping_add(1);
        packet.sequence = self.own_sequence;
    }

    fn on_send(&mut self, packet: &mut Packet) {
        packet.sequence = self.bench_sequence;
    }
}

#[derive(Default)]
pub(crate) struct RestartAfterStop {
    configured: Option<Configure>,
    stopped: bool,
}

impl Mutant for RestartAfterStop {
    fn on_configure(&mut self, configure: &mut Configure) {
        *self = Self { configured: Some(*configure), stopped: false };
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(Command { state, .. }) = packet.message {
            self.stopped = state == ControllerState::Fault;
        }
    }

    fn before_sample(&mut self, sequence: u8) -> Option<Packet> {
        let configure = self.configured.filter(|_| std::mem::take(&mut self.stopped))?;
        // The bench expects no answer with the previous sequence number any more.
        Some(Packet { sequence: sequence.wrapping_sub(1), message: Message::Configure(configure) })
    }
}
