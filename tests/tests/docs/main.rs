//! Compares the documentation with the program, the sources and the scenarios.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

mod blocks;
mod book;
mod command;
mod diffs;
mod examples;
mod justfile;
mod links;
mod page;
mod played_recipes;
mod reference;
mod scenario_path;
mod templates;
mod tutorial;
