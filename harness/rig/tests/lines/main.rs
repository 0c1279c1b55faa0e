//! Tests serial ports, pseudo-terminals and programs behind them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod network;
mod programs;
mod serial;

use platebench_wire::{Configure, Sample};
use std::time::Duration;

/// The watchdog timeout is long, because a busy machine may delay the samples.
const CONFIGURE: Configure = Configure { watchdog_timeout_ms: 1_000, ..platebench_test_kit::CONFIGURE };

const RECEIVE_TIMEOUT: Duration = Duration::from_secs(10);

fn sample(step: u32) -> Sample {
    let wave = (step as f32 * 0.7).sin();
    Sample { time_us: step * 1_000, setpoint_um: 2.0, wd_um: 1.5 + wave, wq_um: 0.3 * wave }
}
