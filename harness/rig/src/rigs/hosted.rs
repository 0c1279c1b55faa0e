//! Runs the controller crate in this process: the same source and the same bytes as on the board.

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory};
use crate::link::{BoxedLink, Link, LinkError};
use platebench_controller::Device;
use platebench_wire::{Identity, LawId, capabilities};
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
