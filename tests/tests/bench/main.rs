//! Tests of the whole bench, through its program and through its libraries.

mod bench;
mod closed_loop;
mod determinism;
mod exits;
mod layout;
mod scenarios;
mod signals;
mod stored;
