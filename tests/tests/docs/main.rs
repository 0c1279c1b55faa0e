//! Compares the documentation with the project.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

mod blocks;
mod book;
mod command;
mod examples;
mod justfile;
mod links;
mod page;
mod reference;
mod source;
mod templates;
mod tutorial;
