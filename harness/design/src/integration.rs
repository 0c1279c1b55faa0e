//! Integrates the plate's equations with a fixed step, and finds the largest stable steps.

pub mod failure;
pub mod fixed;
pub mod problem;
pub mod stability;

pub use failure::MethodFailure;
pub use fixed::FixedStepMethod;
pub use problem::Problem;
pub use stability::{StepLimit, StepLimitRow};
