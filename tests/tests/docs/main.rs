//! The documentation is held to the program: links lead somewhere, commands parse, files load, the tutorial is played, and the reference is made from the code.

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
mod links;
mod page;
mod reference;
mod source;
mod tutorial;
