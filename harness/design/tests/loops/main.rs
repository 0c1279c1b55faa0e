//! Compares loops with known values, with each other and with the firmware's code.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod detuned_start;
mod firmware_agreement;
mod known_values;
mod linear_plant;
mod measured_margins;
mod step_limits;
mod tables;
mod tuning;

use platebench_design::loops::PiGains;

#[track_caller]
fn assert_close(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance, "{found} instead of {expected} ± {tolerance}");
}

fn scaled(pi: PiGains, factor: f64) -> PiGains {
    PiGains { proportional: pi.proportional * factor, integral_per_period: pi.integral_per_period * factor }
}
