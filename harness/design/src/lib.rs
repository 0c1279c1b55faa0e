//! Identifies plate parameters, analyses control loops and their stability, and tunes gains.

pub mod identify;
pub mod integration;
pub mod loops;
pub mod stability;
pub mod tuning;
