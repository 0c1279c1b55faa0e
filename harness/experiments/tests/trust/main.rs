//! Plays the mutants of the catalogue in the scenarios of the repository.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a panic fails the test")]

mod catalogue;
mod protocol_faults;
mod verdicts;
