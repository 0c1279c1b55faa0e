//! General integration methods on the plate's equations, for comparison with its exact propagation.
//!
//! The bench never runs them: nothing but charts and their tests may import this crate.
