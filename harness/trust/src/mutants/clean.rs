//! Varies correct controllers: gains, compute time, clock and the size of reads.

use super::hooks::{on_configure, on_send};
use crate::mutant_controller::Mutant;
use platebench_wire::{Command, LawId, Message};

/// Designs for a plate with `factor` of the gain, so its gains are those divided by `factor`.
/// Other laws use the gain as a feedforward, and `deadbeat` for its first period: they keep it.
pub(crate) fn other_gains(factor: f32) -> Box<dyn Mutant> {
    on_configure(move |configure| {
        let has_amplitude_loop = matches!(
            configure.law,
            LawId::DqPi | LawId::DqPiFixed | LawId::DqPiEuler | LawId::VoltageOnly | LawId::BangBang
        );
        if has_amplitude_loop {
            configure.gain_um_per_vpp *= factor;
        }
    })
}

/// Reports a compute time of 200 µs per step.
pub(crate) fn reported_compute_time() -> Box<dyn Mutant> {
    on_send(|packet| {
        if let Message::Command(command) = &mut packet.message {
            command.compute_us = 200;
        }
    })
}

/// Runs on a clock of its own: starts anywhere, wraps, and is 100 ppm fast.
pub(crate) fn own_clock() -> Box<dyn Mutant> {
    const START_US: u32 = u32::MAX - 20_000;
    on_send(|packet| {
        if let Message::Command(Command { target_time_us: time, .. }) = &mut packet.message {
            *time = time.wrapping_add(*time / 10_000).wrapping_add(START_US);
        }
    })
}

/// Reads its line byte by byte.
pub(crate) struct ByteWiseReads;

impl Mutant for ByteWiseReads {
    fn reads_bytewise(&self) -> bool {
        true
    }
}
