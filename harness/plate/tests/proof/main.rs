//! The plate against a reference that shares nothing with it: equation 1 on the real carrier,
//! integrated with order 8.
//!
//! Every test prints the error that it measured: `cargo test -p platebench-plate -- --nocapture`.
//! The table of `docs/mathematics.md` is made of these lines.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod carrier;
mod crossings;
mod limits;
mod linear;
mod paper;
mod propagation;
mod reference;
mod varying;
