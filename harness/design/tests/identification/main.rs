//! Tests identification: simulated recordings, coverage of intervals, inconsistencies, faults of logs,
//! CSV tables.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod alignment;
mod coverage;
mod effects;
mod inconsistency;
mod instruments;
mod interval_coverage;
mod lost_rows;
mod orientation;
mod plate;
mod simulation;
mod telemetry;
