//! Defines bounds that reading, checking and the JSON Schemas share.

pub(crate) const MAX_DELAY_PERIODS: u64 = 100;
/// A higher quality factor is a mistyped unit. Far above this one, rounding removes the damping.
pub(crate) const MAX_QUALITY: f64 = 1e9;
