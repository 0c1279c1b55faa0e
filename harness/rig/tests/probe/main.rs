//! Tests `--rig probe` without a board: probe-rs accesses an emulated chip. USB, SWD signals and
//! real flash algorithms are not tested, see `docs/attach-a-board.md`.

#![allow(clippy::unwrap_used, reason = "a failed fixture fails the test")]

mod chip;
mod emulated_probe;
mod flashing;
mod image;
mod ports;
mod rtt_buffers;
mod rtt_exchange;
mod setup;

use chip::CHIP;
use emulated_probe::SharedChip;
use image::ImageSpec;
use platebench_rig::probe::{AttachedBoard, ProbeError, ProbeSetup, ProbeSpec, RttLink, Timeouts};
use std::time::Duration;

/// Longest duration on a busy machine of a wait that a time-out of at most 2 s ends.
const BUSY_MACHINE_LIMIT: Duration = Duration::from_mins(1);

fn timeouts() -> Timeouts {
    Timeouts {
        attach: Duration::from_secs(10),
        flash: Duration::from_secs(20),
        reset: Duration::from_secs(2),
        rtt: Duration::from_millis(300),
        handshake: Duration::from_millis(400),
        exchange: Duration::from_millis(100),
        crash: Duration::from_secs(2),
        grace: Duration::from_millis(300),
    }
}

fn spec() -> ProbeSpec {
    CHIP.parse().unwrap()
}

fn attach(chip: &SharedChip) -> Result<AttachedBoard, ProbeError> {
    AttachedBoard::attach(&spec(), chip.lister(), timeouts())
}

fn link(chip: &SharedChip, image: &ImageSpec) -> Result<RttLink, ProbeError> {
    ProbeSetup::new(spec(), &image.elf(), None)?.connect_rtt(chip.lister(), timeouts())
}
