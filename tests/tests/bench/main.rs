//! Tests of the whole bench, through its program and through its libraries.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

mod accept;
mod authoring;
mod bench;
mod closed_loop;
mod determinism;
mod exits;
mod extremes;
mod faults;
mod formats;
mod golden;
mod identify;
mod layout;
mod line;
mod live;
mod real_plate;
mod real_time;
mod rigs;
mod safe_exit;
mod scenarios;
mod signals;
mod stored;
mod trend;
mod tune;
