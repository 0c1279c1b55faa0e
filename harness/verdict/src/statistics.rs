//! Computes intervals over trials.
//!
//! Each end of an interval is a one-sided bound at the stated confidence c (two one-sided tests):
//! `at_most` is demonstrated if the upper end meets it. As a two-sided interval it has the
//! confidence `2c − 1`. The tests simulate the coverage.

pub mod alpha_spending;
pub mod bootstrap;
pub mod bounds;
pub mod equivalence;
pub mod normality;
pub mod proportion;
pub mod quantile;
pub mod sample_summary;

pub use bounds::{deviation_bounds, mean_bounds};
pub use sample_summary::SampleSummary;

#[cfg(test)]
mod tests;
