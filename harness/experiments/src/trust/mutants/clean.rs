//! Varies correct controllers: gains, compute time, clock and the size of reads.

use super::hooks::{on_configure, on_send};
use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, LawId, Message};

/// Multiplies the plate gain that the law is designed for by `factor`. This divides the amplitude
/// gains by `factor`. Laws without an amplitude loop keep the gain, because they use it as a
/// feedforward, `deadbeat` only in its first period.
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

pub(crate) fn reported_compute_time() -> Box<dyn Mutant> {
    on_send(|packet| {
        if let Message::Command(command) = &mut packet.message {
            command.compute_us = 200;
        }
    })
}

pub(crate) fn own_clock() -> Box<dyn Mutant> {
    const START_US: u32 = u32::MAX - 20_000;
    on_send(|packet| {
        if let Message::Command(Command { target_time_us: time, .. }) = &mut packet.message {
            *time = time.wrapping_add(*time / 10_000).wrapping_add(START_US);
        }
    })
}

pub(crate) struct ByteWiseReads;

impl Mutant for ByteWiseReads {
    fn reads_bytewise(&self) -> bool {
        true
    }
}
