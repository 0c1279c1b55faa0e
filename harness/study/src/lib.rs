//! Studies the plate and its control laws. Running scenarios does not need this crate.

pub mod charts;
mod cost;
pub mod integration;
pub mod loops;
