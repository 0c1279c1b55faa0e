//! Runs a lab: acceptance sessions with a person, and several boards.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod acceptance;
pub mod boards;
