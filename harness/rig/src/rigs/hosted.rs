//! Runs the controller crate in this process: the same source as on the board.

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory};
use crate::link::{BoxedLink, Link, LinkError};
use platebench_controller::Device;
use platebench_wire::{Identity, LawId, Packet, PacketReader, capabilities};
use std::time::Duration;

pub(super) const RIG: RigFactory = RigFactory {
    name: "hosted",
    argument: Argument::None,
    help: "the controller's source in the process of the bench",
    capabilities: &[Capability::Simulated, Capability::ParallelLinks],
    parse: |_| Ok(Box::new(HostedRig)),
};

#[derive(Debug)]
pub(super) struct HostedRig;

impl Rig for HostedRig {
    fn open(&self, _: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Ok(Box::new(HostedLink::new()))
    }
}

#[derive(Debug, Clone)]
pub struct HostedLink {
    device: Device,
    /// Start of the trial on the device's clock.
    trial_start: Duration,
    now: Duration,
}

impl Default for HostedLink {
    fn default() -> Self {
        Self::new()
    }
}

impl HostedLink {
    pub fn new() -> Self {
        Self { device: Device::new(identity()), trial_start: Duration::ZERO, now: Duration::ZERO }
    }

    /// Device's clock at the trial time `now`, µs; it wraps after 2³² µs, as on the board.
    fn device_us(&mut self, now: Duration) -> u32 {
        self.now = self.trial_start + now;
        self.now.as_micros() as u32
    }
}

fn identity() -> Identity {
    let number = |text: &str| text.parse().unwrap_or_default();
    Identity {
        version: [
            number(env!("CARGO_PKG_VERSION_MAJOR")),
            number(env!("CARGO_PKG_VERSION_MINOR")),
            number(env!("CARGO_PKG_VERSION_PATCH")),
        ],
        capabilities: capabilities::TARGET_PACED | capabilities::LOOP_DELAY,
        laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
        build: [0; 8],
        chip: 0,
        unique: [0; 12],
        name: *b"platebench-host\0",
    }
}

impl Link for HostedLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let now_us = self.device_us(now);
        self.device.receive(bytes, now_us, |frame| answer.extend_from_slice(frame));
        Ok(Duration::ZERO)
    }

    fn answer_sample(&mut self, now: Duration, packet: &Packet, is_checked: bool) -> Option<Result<Packet, LinkError>> {
        let now_us = self.device_us(now);
        let before = is_checked.then(|| self.device.clone());
        let answer = self.device.answer(packet, now_us)?;
        let is_wrong = before.is_some_and(|device| !bytes_agree(device, packet, &answer, now_us));
        Some(if is_wrong { Err(LinkError::BytesDiffer(now)) } else { Ok(answer) })
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let now_us = self.device_us(now);
        self.device.tick(now_us, |frame| received.extend_from_slice(frame));
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        *self = Self::new();
        Ok(true)
    }

    fn continue_trial(&mut self) {
        self.trial_start = self.now;
    }
}

/// True if `device` gives `answer` to the bytes of `packet`.
fn bytes_agree(mut device: Device, packet: &Packet, answer: &Packet, now_us: u32) -> bool {
    let mut bytes = Vec::new();
    device.receive(packet.encode().as_bytes(), now_us, |frame| bytes.extend_from_slice(frame));
    PacketReader::new().packets(&bytes).eq([Ok(*answer)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::{Command, Message, Sample};

    #[test]
    fn another_answer_to_the_bytes_is_found() {
        let message = Message::Sample(Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.5, wq_um: 0.0 });
        let (packet, device) = (Packet { sequence: 1, message }, HostedLink::new().device);
        let answer = device.clone().answer(&packet, 7).unwrap();
        let Message::Command(command) = answer.message else { panic!("{answer:?}") };
        let other = Packet { message: Message::Command(Command { flags: 16, ..command }), ..answer };
        assert!(bytes_agree(device.clone(), &packet, &answer, 7));
        assert!(!bytes_agree(device, &packet, &other, 7));
    }
}
