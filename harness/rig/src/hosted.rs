//! Runs the controller crate in this process: the same source and the same bytes as on the board.

use crate::link::{Link, LinkError};
use platebench_controller::Device;
use platebench_wire::{Identity, LawId, capabilities};
use std::time::Duration;

#[derive(Debug, Clone)]
pub struct HostedLink {
    device: Device,
}

impl Default for HostedLink {
    fn default() -> Self {
        Self::new()
    }
}

impl HostedLink {
    pub fn new() -> Self {
        Self { device: Device::new(identity()) }
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

/// Wraps, as on the board.
fn micros(now: Duration) -> u32 {
    now.as_micros() as u32
}

impl Link for HostedLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.device.receive(bytes, micros(now), |frame| answer.extend_from_slice(frame));
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.device.tick(micros(now), |frame| received.extend_from_slice(frame));
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        *self = Self::new();
        Ok(true)
    }
}
