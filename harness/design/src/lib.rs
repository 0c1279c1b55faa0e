//! Identifies plate parameters, analyses control loops and their stability, and tunes gains.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod identified_plate;
pub mod identify;
pub mod law_loops;
pub mod loops;
pub mod margins;
pub mod plate_history;
pub mod stability;
mod stability_map;
pub mod step_limits;
pub mod tuning;
