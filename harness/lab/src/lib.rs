//! Runs a lab: acceptance sessions with a person, and several boards.

pub mod acceptance;
pub mod boards;
