//! Lines in real time: serial ports, of which a pseudo-terminal is one, and programs behind one.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod exec;
mod serial;
mod stranger;

use platebench_wire::{Configure, LawId, Sample};
use std::time::Duration;

const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    patience_ms: 1_000,
    period_us: 1_000,
    loop_delay_us: 0,
    start_frequency_mhz: 32_307_600,
    gain_um_per_vpp: 0.00698,
    time_constant_s: 1.88e-3,
    response_time_s: 0.0,
    drive_limit_vpp: 900.0,
    frequency_range_hz: 250.0,
    frequency_slew_hz: 100.0,
    gains: None,
};

/// On a busy machine everything may come late, but it comes.
const WITHIN: Duration = Duration::from_secs(10);

/// Something for a controller to do.
fn sample(step: u32) -> Sample {
    let wave = (step as f32 * 0.7).sin();
    Sample { time_us: step * 1_000, setpoint_um: 2.0, wd_um: 1.5 + wave, wq_um: 0.3 * wave }
}
