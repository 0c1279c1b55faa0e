//! Defines bounds that reading, checking and the JSON Schemas share.

pub(crate) const MAX_PERIOD_MS: f64 = 1_000.0;
pub(crate) const MAX_DELAY_PERIODS: u64 = 100;
pub(crate) const MAX_TRIALS: i64 = 100_000;
pub(crate) const MAX_SPREAD_PERCENT: f64 = 20.0;
/// A higher quality factor is a mistyped unit. Far above this one, rounding removes the damping.
pub(crate) const MAX_QUALITY: f64 = 1e9;
pub(crate) const MAX_BETWEEN: usize = 16;
