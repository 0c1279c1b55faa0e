//! `--rig probe` without a board: probe-rs's own debug port, Cortex-M, STM32, flash loader and RTT code works on an emulated memory map.
//!
//! What this cannot show stands in `docs/attach-a-board.md`: USB, SWD signals, real flash algorithms.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod chip;
mod emulated;
mod ends;
mod finds;
mod flashes;
mod image;
mod ports;
mod rtt;
mod setups;
mod talks;
mod traps;

use chip::CHIP;
use emulated::Bench;
use image::Recipe;
use platebench_rig::probe::{Attached, Patience, ProbeError, ProbeSpec, RttLink, Setup};
use std::time::Duration;

/// Short waits, so that what hangs is seen to end.
fn patience() -> Patience {
    Patience {
        attach: Duration::from_secs(10),
        flash: Duration::from_secs(20),
        reset: Duration::from_secs(2),
        rtt: Duration::from_millis(300),
        introduction: Duration::from_millis(400),
        exchange: Duration::from_millis(100),
        fault: Duration::from_secs(2),
        grace: Duration::from_millis(300),
    }
}

fn spec() -> ProbeSpec {
    CHIP.parse().unwrap()
}

fn attach(bench: &Bench) -> Result<Attached, ProbeError> {
    Attached::attach(&spec(), bench.lister(), patience())
}

/// A link to a board that runs what `recipe` says.
fn link(bench: &Bench, recipe: &Recipe) -> Result<RttLink, ProbeError> {
    Setup::new(spec(), &recipe.elf(), None)?.over_rtt(bench.lister(), patience())
}
