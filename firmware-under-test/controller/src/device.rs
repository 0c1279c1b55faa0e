//! Decodes the bytes from the line, runs the state machine and encodes the answers.

use crate::pacer::Pacer;
use crate::state_machine::StateMachine;
use platebench_wire::{
    Command, Configure, Configured, FrameReader, Identity, Message, Packet, Rejection, capabilities,
};

#[derive(Debug, Clone)]
pub struct Device {
    identity: Identity,
    reader: FrameReader,
    machine: StateMachine,
    last_sequence: Option<u8>,
    compute_us: u16,
    pacer: Option<Pacer>,
}

impl Device {
    /// The device rejects target pacing if `identity` lacks [`capabilities::TARGET_PACED`].
    pub fn new(identity: Identity) -> Self {
        let (reader, machine) = (FrameReader::new(), StateMachine::new());
        Self { identity, reader, machine, last_sequence: None, compute_us: 0, pacer: None }
    }

    /// `now_us` is the time on the target's clock. Calls `send` once for each frame of the answer.
    pub fn receive(&mut self, mut bytes: &[u8], now_us: u32, mut send: impl FnMut(&[u8])) {
        while let Some(frame) = self.reader.read(&mut bytes) {
            let packet = frame.ok().and_then(|body| Packet::decode(body).ok());
            let answer = match packet {
                Some(packet) => self.answer(&packet, now_us),
                None => self.machine.count_rejected_frame(now_us).map(|command| self.unsolicited(command)),
            };
            if let Some(answer) = answer {
                send(answer.encode().as_bytes());
            }
        }
    }

    /// Checks the watchdog and sends a due tick. Needs a call per period and at
    /// [`Device::next_tick_us`].
    pub fn tick(&mut self, now_us: u32, mut send: impl FnMut(&[u8])) {
        if let Some(command) = self.machine.tick(now_us) {
            send(self.unsolicited(command).encode().as_bytes());
        }
        let state = self.machine.output().state;
        self.pacer = self.pacer.filter(|pacer| pacer.is_active(state, now_us));
        if let Some(tick) = self.pacer.as_mut().and_then(|pacer| pacer.tick(now_us)) {
            send(tick.encode().as_bytes());
        }
    }

    pub fn period_us(&self) -> Option<u32> {
        self.machine.period_us()
    }

    /// Time of the next tick on the target's clock; `None` unless the target paces the control.
    pub fn next_tick_us(&self) -> Option<u32> {
        self.pacer.as_ref().map(Pacer::next_us)
    }

    pub fn output(&self) -> &Command {
        self.machine.output()
    }

    /// Duration of the last call of [`Device::receive`], which the next command reports.
    pub fn set_compute_us(&mut self, compute_us: u16) {
        self.compute_us = compute_us;
    }

    /// Answer to a message that was decoded elsewhere. `None` if a target does not answer it.
    pub fn answer(&mut self, packet: &Packet, now_us: u32) -> Option<Packet> {
        let message = match &packet.message {
            Message::Hello => Message::Identity(self.identity),
            Message::Configure(configure) => Message::Configured(self.configure(configure, now_us)),
            Message::Sample(sample) => {
                // The line repeated the frame, so the device repeats its answer without a step.
                let repeated = self.last_sequence.replace(packet.sequence) == Some(packet.sequence);
                let command = if repeated { *self.machine.output() } else { self.machine.sample(sample, now_us) };
                Message::Command(Command { compute_us: self.compute_us, ..command })
            }
            Message::Safe => Message::Command(self.machine.enter_safe(now_us)),
            // This device has no own plate, so it ignores `Setpoint`. Only a target sends the other
            // messages, so the line must have echoed them.
            Message::Setpoint(_)
            | Message::Identity(_)
            | Message::Configured(_)
            | Message::Command(_)
            | Message::Fault(_)
            | Message::Tick(_)
            | Message::Telemetry(_) => return None,
        };
        Some(Packet { sequence: packet.sequence, message })
    }

    fn configure(&mut self, configure: &Configure, now_us: u32) -> Configured {
        self.last_sequence = None;
        self.pacer = None;
        let cannot_pace = configure.paced_by_target && !self.identity.has_capability(capabilities::TARGET_PACED);
        if cannot_pace || configure.drives_own_plate {
            return Configured { outcome: Err(self.machine.reject(Rejection::Value)) };
        }
        let configured = self.machine.configure(configure);
        if configure.paced_by_target && configured.outcome.is_ok() {
            self.pacer = Some(Pacer::new(configure, now_us));
        }
        configured
    }

    fn unsolicited(&self, command: Command) -> Packet {
        Packet { sequence: self.last_sequence.unwrap_or(0), message: Message::Command(command) }
    }
}

#[cfg(test)]
mod tests;
