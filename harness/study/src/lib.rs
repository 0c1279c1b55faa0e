//! Studies the plate and its control laws. Running scenarios does not need this crate.
//!
//! * [`integration`]: general integration methods on the plate's equations, compared with the exact
//!   propagation.
//! * [`loops`]: poles, margins, stability boundaries and tuning of each law on a plate.

pub mod integration;
pub mod loops;
