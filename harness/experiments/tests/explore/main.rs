//! Tests generation, limits, playing and shrinking.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a panic fails the test")]

mod envelope;
mod exploration;
mod false_alarms;
mod fixtures;
mod generation;
mod guidance;
mod own_laws;
mod relations;
mod sensor_column;
mod sequences;
mod surviving_faults;
mod ways_of_playing;
