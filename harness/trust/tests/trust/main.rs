//! The catalogue against the scenarios of the repository.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

mod catalogue;
mod judged;
mod suite;
