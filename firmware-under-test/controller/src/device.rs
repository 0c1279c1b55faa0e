//! Bytes in, bytes out: what a board's main loop or a hosted rig calls.

use crate::machine::Machine;
use crate::pacing::Pacer;
use platebench_wire::{
    Command, Configure, Configured, FrameReader, Identity, Message, Packet, Rejection, capabilities,
};

/// A controller on its line.
#[derive(Debug, Clone)]
pub struct Device {
    identity: Identity,
    reader: FrameReader,
    machine: Machine,
    /// Sequence number of the last sample that was acted on.
    last_sequence: Option<u8>,
    compute_us: u16,
    /// Where the target's own timer paces the control.
    pacer: Option<Pacer>,
}

impl Device {
    /// A controller at 0 V that will answer as `identity`. Without [`capabilities::TARGET_PACED`] there it refuses to pace itself.
    pub fn new(identity: Identity) -> Self {
        let (reader, machine) = (FrameReader::new(), Machine::new());
        Self { identity, reader, machine, last_sequence: None, compute_us: 0, pacer: None }
    }

    /// Takes in what the line brought, at `now_us` on the target's clock, and sends what is to be answered, a frame a call.
    pub fn receive(&mut self, bytes: &[u8], now_us: u32, mut send: impl FnMut(&[u8])) {
        for &byte in bytes {
            let Some(frame) = self.reader.push(byte) else { continue };
            let packet = frame.ok().and_then(|body| Packet::decode(body).ok());
            let answer = match packet {
                Some(packet) => self.answer(&packet, now_us),
                None => self.machine.refused_frame(now_us).map(|command| self.unasked(command)),
            };
            if let Some(answer) = answer {
                send(answer.encode().as_bytes());
            }
        }
    }

    /// Lets time pass without bytes; to be called at least once per period, and where the target paces the control also at [`Device::next_tick_us`].
    pub fn tick(&mut self, now_us: u32, mut send: impl FnMut(&[u8])) {
        if let Some(command) = self.machine.tick(now_us) {
            send(self.unasked(command).encode().as_bytes());
        }
        let state = self.machine.output().state;
        self.pacer = self.pacer.filter(|pacer| pacer.goes_on(state, now_us));
        if let Some(tick) = self.pacer.as_mut().and_then(|pacer| pacer.tick(now_us)) {
            send(tick.encode().as_bytes());
        }
    }

    /// The control period of the configuration in force.
    pub fn period_us(&self) -> Option<u32> {
        self.machine.period_us()
    }

    /// When the next period of a control that the target paces begins, on the target's clock: what a board sets its timer to.
    pub fn next_tick_us(&self) -> Option<u32> {
        self.pacer.as_ref().map(Pacer::next_us)
    }

    /// What the plate is driven with now: for a board that has an amplifier of its own.
    pub fn output(&self) -> &Command {
        self.machine.output()
    }

    /// How long the last call of [`Device::receive`] took; told to the bench with the next command.
    pub fn set_compute_us(&mut self, compute_us: u16) {
        self.compute_us = compute_us;
    }

    fn answer(&mut self, packet: &Packet, now_us: u32) -> Option<Packet> {
        let message = match &packet.message {
            Message::Hello => Message::Identity(self.identity),
            Message::Configure(configure) => Message::Configured(self.configure(configure, now_us)),
            Message::Sample(sample) => {
                // A frame that the line doubled is answered again, not controlled with again.
                let repeated = self.last_sequence.replace(packet.sequence) == Some(packet.sequence);
                let command = if repeated { *self.machine.output() } else { self.machine.sample(sample, now_us) };
                Message::Command(Command { compute_us: self.compute_us, ..command })
            }
            Message::Safe => Message::Command(self.machine.safe(now_us)),
            // There is no plate on this side of the line.
            Message::Setpoint(_)
            // Only a target says these; a line that echoes is no reason to act.
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
        let cannot_pace = configure.paced_by_target && !self.identity.can(capabilities::TARGET_PACED);
        if cannot_pace || configure.drives_own_plate {
            return Configured { outcome: Err(self.machine.refuse(Rejection::Value)) };
        }
        let configured = self.machine.configure(configure);
        if configure.paced_by_target && configured.outcome.is_ok() {
            self.pacer = Some(Pacer::new(configure, now_us));
        }
        configured
    }

    fn unasked(&self, command: Command) -> Packet {
        Packet { sequence: self.last_sequence.unwrap_or(0), message: Message::Command(command) }
    }
}

#[cfg(test)]
mod tests;
