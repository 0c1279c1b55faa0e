//! Compares integration methods with known values and with each other.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod crossings;
mod extended_precision;
mod methods;
