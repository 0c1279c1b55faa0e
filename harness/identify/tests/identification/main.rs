//! Tests of identification: simulated recordings, coverage of intervals, inconsistencies, tables of
//! other programs.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod coverage;
mod effects;
mod inconsistency;
mod interval_coverage;
mod plate;
mod simulation;
mod telemetry;
