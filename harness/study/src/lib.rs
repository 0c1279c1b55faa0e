//! Studies the plate and its control laws. Running scenarios does not need this crate.
//!
//! * [`integration`]: general integration methods on the plate's equations, compared with the exact
//!   propagation.
//! * [`loops`]: poles, margins, stability boundaries and tuning of each law on a plate.
//! * [`charts`]: measurements as drawings, tables and files.

pub mod charts;
mod cost;
pub mod integration;
pub mod loops;
