//! Implements the mutants.
//!
//! * [`values`]: wrong numbers.
//! * [`timing`]: correct numbers at the wrong time.
//! * [`excitation`]: wrong excitation frequency or demodulation phase.
//! * [`line`]: wrong treatment of frames and states.
//! * [`loops`]: independent PI loops with one line missing.
//! * [`plate_changes`]: wrong reaction to a finger that leaves, and to a steady state.
//! * [`protocol`]: wrong treatment of configurations, time stamps and answers.
//! * [`clean`]: variants without a mistake.

pub(crate) mod clean;
pub(crate) mod excitation;
pub(crate) mod line;
pub(crate) mod loops;
pub(crate) mod plate_changes;
pub(crate) mod protocol;
pub(crate) mod timing;
pub(crate) mod values;
