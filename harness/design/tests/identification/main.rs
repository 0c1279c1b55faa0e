//! Tests identification: simulated recordings, coverage of intervals, inconsistencies, CSV tables.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod coverage;
mod effects;
mod inconsistency;
mod interval_coverage;
mod plate;
mod simulation;
mod telemetry;
