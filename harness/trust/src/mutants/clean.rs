//! Varies correct controllers: gains, compute time, clock and the size of reads.

use crate::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, LawId, Message, Packet};

/// Designs for a plate with `factor` of the gain, so its gains are those divided by `factor`.
/// Other laws use the gain as a feedforward, and `deadbeat` for its first period: they keep it.
pub(crate) struct OtherGains(pub(crate) f32);

impl Mutant for OtherGains {
    fn on_configure(&mut self, configure: &mut Configure) {
        let has_amplitude_loop = matches!(
            configure.law,
            LawId::DqPi | LawId::DqPiFixed | LawId::DqPiEuler | LawId::VoltageOnly | LawId::BangBang
        );
        if has_amplitude_loop {
            configure.gain_um_per_vpp *= self.0;
        }
    }
}

/// Reports a compute time of 200 µs per step.
pub(crate) struct ReportedComputeTime;

impl Mutant for ReportedComputeTime {
    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(command) = &mut packet.message {
            command.compute_us = 200;
        }
    }
}

/// Runs on a clock of its own: starts anywhere, wraps, and is 100 ppm fast.
pub(crate) struct OwnClock;

impl OwnClock {
    const START_US: u32 = u32::MAX - 20_000;

    fn shift(command: &mut Command) {
        let drift_us = command.target_time_us / 10_000;
        command.target_time_us = command.target_time_us.wrapping_add(drift_us).wrapping_add(Self::START_US);
    }
}

impl Mutant for OwnClock {
    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(command) = &mut packet.message {
            Self::shift(command);
        }
    }
}

/// Reads its line byte by byte.
pub(crate) struct ByteWiseReads;

impl Mutant for ByteWiseReads {
    fn reads_bytewise(&self) -> bool {
        true
    }
}
