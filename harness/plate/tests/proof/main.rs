//! Compares the plate with an independent reference: equation 1 on the real carrier, integrated by
//! a method of order 8. Every test prints its error for the table of `docs/mathematics.md`.

#![allow(clippy::unwrap_used, reason = "a failed fixture fails the test")]

mod carrier;
mod crossings;
mod effects;
mod effects_reference;
mod intervals;
mod limits;
mod linear;
mod paper;
mod propagation;
mod random_plates;
mod reference;
mod varying;
