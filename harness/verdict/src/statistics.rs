//! Intervals for what only many trials can tell.
//!
//! * [`summary`]: mean and standard deviation of normal data, by t and chi-square.
//! * [`normality`]: whether data may be taken as normal.
//! * [`bootstrap`]: mean and deviation of data that may not.
//! * [`proportion`]: how often something happens.
//! * [`quantile`]: what so many of a hundred trials keep to.
//! * [`equivalence`]: whether something is practically zero.
//! * `spending`: how looking several times is paid for.
//!
//! Each end of an interval is a one-sided bound at the stated confidence: `at_most` is demonstrated when the upper end keeps to it. That is the two
//! one-sided tests' convention; as a two-sided interval it has the confidence `2c − 1`. How well each covers is simulated in the tests of this module.

pub mod alpha_spending;
pub mod bootstrap;
pub mod equivalence;
pub mod normality;
pub mod proportion;
pub mod quantile;
pub mod summary;

pub use summary::{SampleSummary, deviation_bounds, mean_bounds};

#[cfg(test)]
mod tests;
