//! Plays many variants of scenarios, controllers and firmware, and measures what the scenarios
//! detect.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

#[cfg(feature = "campaign")]
pub mod campaign;
pub mod explore;
#[cfg(feature = "firmware-analysis")]
pub mod firmware_analysis;
#[cfg(feature = "firmware-analysis")]
pub mod mutation;
pub mod trust;
